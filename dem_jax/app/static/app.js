// Marks the step of the page, and joins the 3-D view of a drop with the cursor in its force.
"use strict";

function markStep(path) {
  for (const link of document.querySelectorAll("nav .step")) {
    if (link.dataset.path === path) link.setAttribute("aria-current", "page");
    else link.removeAttribute("aria-current");
  }
  window.scrollTo(0, 0);
}

let followed = null; // id of the chart that has the cursor

function chartOf(id) {
  const element = getElement(id);
  return element && element.chart;
}

function followDrop(id) {
  followed = id;
  const join = () => {
    const chart = chartOf(id);
    if (!chart) return setTimeout(join, 50);
    chart.getZr().on("click", (event) => {
      const [time] = chart.convertFromPixel({ gridIndex: 0 }, [event.offsetX, event.offsetY]);
      sendTime(time);
    });
  };
  join();
}

function sendTime(time) {
  const view = document.getElementById("drop-view");
  if (view) view.contentWindow.postMessage({ dropTime: time }, location.origin);
  moveCursor(time);
}

function moveCursor(time) {
  const chart = followed !== null && chartOf(followed);
  if (!chart) return;
  const line = { animation: false, symbol: "none", silent: true, label: { show: false }, data: [{ xAxis: time }] };
  const style = { color: "#b91c1c", type: "solid", width: 1.5 };
  const series = chart.getOption().series.map(() => ({ markLine: { ...line, lineStyle: style } }));
  chart.setOption({ series });
}

window.addEventListener("message", (event) => {
  if (event.origin === location.origin && event.data && typeof event.data.dropShown === "number") moveCursor(event.data.dropShown);
});

// The input of an upload has a button beside it; its own name is for readers of the screen.
new MutationObserver(() => {
  for (const input of document.querySelectorAll("input.q-uploader__input:not([aria-label])")) input.setAttribute("aria-label", "STL file");
}).observe(document, { childList: true, subtree: true });
