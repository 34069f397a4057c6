// The 3-D view inside the pages: #source=ADDRESS names its data, "plays" lets it begin, "keeps" leaves camera and
// instant as they are. While a drop is computed it asks again and again. It tells the page around which instant
// (ms) is shown, and shows the one that it asks for.
"use strict";

(function () {
  const PAUSE = 200; // ms, at least, between two questions
  const canvas = document.getElementById("drop");
  const slider = document.getElementById("time");
  const shown = document.getElementById("shown");
  let drag = null; // of a bucket: plane, first point, and how far it is moved
  let turn = 0; // of the source that is followed
  let source = null;

  async function follow() {
    const wanted = new URLSearchParams(location.hash.slice(1));
    if (wanted.get("source") === source) return; // it goes on
    const mine = ++turn;
    source = wanted.get("source");
    const options = { plays: wanted.has("plays"), keeps: wanted.has("keeps"), follows: false };
    if (!options.keeps) shown.textContent = "reading …";
    for (let more = true; more; ) {
      const since = performance.now();
      const answer = await fetch(source, { cache: "no-store" }).catch(() => null);
      if (mine !== turn) return;
      if (!answer || !answer.ok) {
        shown.textContent = answer ? await answer.text() : "";
        return;
      }
      const found = answer.status === 204 ? { more: true } : await answer.json();
      if (mine !== turn) return;
      shown.textContent = found.words || shown.textContent;
      if (found.view && (options.follows || !found.more || found.view.time.length > 1)) {
        dropPlayer.put(found.view, { ...options, more: found.more, span: found.span });
        options.follows = true;
        canvas.dataset.source = source;
        drag = null; // of what was shown before
      }
      more = found.more;
      if (more) await new Promise((wake) => setTimeout(wake, Math.max(PAUSE, 2 * (performance.now() - since))));
      if (mine !== turn) return;
    }
  }

  const tell = () => {
    const time = dropPlayer.instants()[Number(canvas.dataset.frame)];
    if (time !== undefined) parent.postMessage({ dropShown: 1e3 * time }, location.origin);
  };
  new MutationObserver(tell).observe(canvas, { attributes: true, attributeFilter: ["data-frame"] });

  addEventListener("message", ({ origin, data }) => {
    if (origin !== location.origin) return;
    if (typeof data.dropTime === "number") {
      const far = (t) => Math.abs(1e3 * t - data.dropTime);
      slider.value = dropPlayer.instants().reduce((best, t, n, all) => (far(t) < far(all[best]) ? n : best), 0);
    } else if (typeof data.dropStep === "number") {
      slider.value = Math.max(0, Number(slider.value) + data.dropStep);
    } else return;
    slider.dispatchEvent(new Event("input"));
  });
  // With "moves" in the hash the weigh bucket is dragged in the vertical plane that faces the eye most: along y and z, or
  // x and z. The page around is told by how much (m), and shows the bucket there.
  const GRID = 1e-3; // m

  function rayAt(event) {
    const { THREE, camera } = dropPlayer.world();
    const frame = canvas.getBoundingClientRect();
    const place = new THREE.Vector2(
      (2 * (event.clientX - frame.left)) / frame.width - 1, 1 - (2 * (event.clientY - frame.top)) / frame.height);
    const ray = new THREE.Raycaster();
    ray.setFromCamera(place, camera);
    return ray;
  }

  function bucketWalls() {
    const { now } = dropPlayer.world();
    const isMoved = new URLSearchParams(location.hash.slice(1)).has("moves") && now && now.groups;
    return isMoved ? now.walls.filter((_, k) => now.groups[k].startsWith("wb")) : [];
  }

  // Where the bucket's surface is below the pointer; its edges are lines, which count from a metre away.
  const hitAt = (event, walls) => rayAt(event).intersectObjects(walls, true).find(({ object }) => object.isMesh);

  canvas.addEventListener("pointerdown", (event) => {
    const walls = bucketWalls();
    if (!walls.length || event.button !== 0) return;
    const { THREE, camera } = dropPlayer.world();
    const hit = hitAt(event, walls);
    if (!hit) return;
    event.stopImmediatePropagation(); // the view does not turn
    const look = camera.getWorldDirection(new THREE.Vector3());
    const normal = Math.abs(look.x) > Math.abs(look.y) ? new THREE.Vector3(1, 0, 0) : new THREE.Vector3(0, 1, 0);
    const plane = new THREE.Plane().setFromNormalAndCoplanarPoint(normal, hit.point);
    drag = { plane, from: hit.point, by: new THREE.Vector3(), walls, at: walls.map((wall) => wall.position.clone()) };
    canvas.setPointerCapture(event.pointerId);
    canvas.style.cursor = "move";
  }, true);

  canvas.addEventListener("pointermove", (event) => {
    if (!drag) {
      canvas.style.cursor = hitAt(event, bucketWalls()) ? "move" : "";
      return;
    }
    event.stopImmediatePropagation();
    const { THREE } = dropPlayer.world();
    const point = rayAt(event).ray.intersectPlane(drag.plane, new THREE.Vector3());
    if (!point) return;
    drag.by.copy(point).sub(drag.from);
    for (const axis of ["x", "y", "z"]) drag.by[axis] = GRID * Math.round(drag.by[axis] / GRID);
    drag.walls.forEach((wall, k) => wall.position.copy(drag.at[k]).add(drag.by));
    dropPlayer.redraw();
    tellMove(false);
  }, true);

  for (const name of ["pointerup", "pointercancel"]) {
    canvas.addEventListener(name, () => {
      if (!drag) return;
      tellMove(true);
      drag = null;
    }, true);
  }

  for (const name of ["mousedown", "touchstart"]) canvas.addEventListener(name, (event) => drag && event.stopImmediatePropagation(), true);

  function tellMove(isOver) {
    parent.postMessage({ bucketMoved: drag.by.toArray(), isOver }, location.origin);
  }

  addEventListener("hashchange", follow);
  follow();
})();
