// Marks the step of the page and whether it is complete, and joins the 3-D view of a drop with the cursor in its force.
"use strict";

function markStep(path) {
  for (const link of document.querySelectorAll("nav .step")) {
    if (link.dataset.path === path) link.setAttribute("aria-current", "page");
    else link.removeAttribute("aria-current");
  }
  document.querySelector(".content").setAttribute("aria-busy", "true");
  window.scrollTo(0, 0);
}

function markComplete(path) {
  const step = document.querySelector("nav .step[aria-current]");
  if (step && step.dataset.path === path) document.querySelector(".content").setAttribute("aria-busy", "false");
}

// Shows another source in a 3-D view; the same one goes on.
function showView(id, source) {
  const view = document.getElementById(id);
  if (!view) return;
  view.dataset.shows = source;
  view.contentWindow.location.replace(`/player#${source}`);
}

let followed = null; // id of the chart that has the cursor

function chartOf(id) {
  const element = getElement(id);
  return element && element.chart;
}

const STEPS = { ArrowLeft: -1, ArrowDown: -1, ArrowRight: 1, ArrowUp: 1, PageDown: -10, PageUp: 10, Home: -1e9, End: 1e9 };

// Joins a chart with the 3-D view: a click or the arrow keys in it choose the instant that both show.
function followDrop(id) {
  followed = id;
  const join = () => {
    const chart = chartOf(id);
    if (!chart) return setTimeout(join, 50);
    chart.getZr().on("click", (event) => {
      const [time] = chart.convertFromPixel({ gridIndex: 0 }, [event.offsetX, event.offsetY]);
      sendTime(time);
    });
    const element = getHtmlElement(id);
    const words = { role: "slider", tabindex: 0, "aria-valuemin": 0, "aria-valuemax": Math.round(lastTime(chart)), "aria-valuenow": 0 };
    for (const [name, value] of Object.entries(words)) element.setAttribute(name, value);
    element.addEventListener("keydown", (event) => {
      if (!(event.key in STEPS)) return;
      event.preventDefault();
      tellView({ dropStep: STEPS[event.key] });
    });
  };
  join();
}

function lastTime(chart) {
  return Math.max(0, ...chart.getOption().series.map(({ data }) => (data.length ? data[data.length - 1][0] : 0)));
}

function tellView(message) {
  const view = document.getElementById("drop-view");
  if (view) view.contentWindow.postMessage(message, location.origin);
}

function sendTime(time) {
  tellView({ dropTime: time });
  moveCursor(time);
}

function moveCursor(time) {
  const chart = followed !== null && chartOf(followed);
  if (!chart) return;
  const line = { animation: false, symbol: "none", silent: true, label: { show: false }, data: [{ xAxis: time }] };
  const style = { color: "#b91c1c", type: "solid", width: 1.5 };
  const series = chart.getOption().series.map(() => ({ markLine: { ...line, lineStyle: style } }));
  chart.setOption({ series });
  const element = getHtmlElement(followed);
  element.setAttribute("aria-valuenow", Math.round(time));
  element.setAttribute("aria-valuetext", `${time.toFixed(1)} ms after the release`);
}

const MOVES = 100; // ms between two messages of a bucket that is dragged
let told = 0;

window.addEventListener("message", ({ origin, data }) => {
  if (origin !== location.origin || !data) return;
  if (typeof data.dropShown === "number") moveCursor(data.dropShown);
  if (data.bucketMoved && (data.isOver || performance.now() - told > MOVES)) {
    told = performance.now();
    const detail = [...data.bucketMoved, data.isOver];
    document.getElementById("bucket-place").dispatchEvent(new CustomEvent("bucketmoved", { detail }));
  }
});

// The input of an upload has a button beside it; its own name is for readers of the screen.
new MutationObserver(() => {
  for (const input of document.querySelectorAll("input.q-uploader__input:not([aria-label])")) input.setAttribute("aria-label", "STL file");
}).observe(document, { childList: true, subtree: true });
