// Tells the page around the player which instant (ms) is shown, and shows the one that it asks for.
(function () {
  const canvas = document.getElementById("drop");
  const slider = document.getElementById("time");
  const time = JSON.parse(document.getElementById("views").textContent)[0].view.time;
  const told = () => parent.postMessage({ dropShown: 1e3 * time[Number(canvas.dataset.frame)] }, location.origin);
  new MutationObserver(told).observe(canvas, { attributes: true, attributeFilter: ["data-frame"] });
  addEventListener("message", (event) => {
    if (event.origin !== location.origin || typeof event.data.dropTime !== "number") return;
    let nearest = 0;
    time.forEach((t, n) => { if (Math.abs(1e3 * t - event.data.dropTime) < Math.abs(1e3 * time[nearest] - event.data.dropTime)) nearest = n; });
    slider.value = nearest;
    slider.dispatchEvent(new Event("input"));
  });
})();
