// Plays the stored poses of the runs of a report. #t=0.25 in the page's address shows that instant (s), #play plays.
// A page around may put a view there by dropPlayer.put, again and again while a drop is computed.
"use strict";

(function () {
  const views = JSON.parse(document.getElementById("views").textContent);
  const canvas = document.getElementById("drop");
  if (!canvas) return;
  const [play, slider, shown, pace, chosen] = ["play", "time", "shown", "pace", "run"].map((id) => document.getElementById(id));
  const PALETTE = [0xf3c6cf, 0xfbe9c6, 0xcfe3f1, 0xd8ecd0, 0xe6d7f0, 0xf8d5b5];
  const MOST_OUTLINED = 400; // pieces

  function numbers(text) {
    const bytes = Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
    return new Float32Array(bytes.buffer);
  }

  function geometryOf(mesh) {
    const made = new THREE.BufferGeometry();
    const points = numbers(mesh.triangles);
    made.setAttribute("position", new THREE.BufferAttribute(points, 3));
    if (mesh.smooth) {
      made.setAttribute("normal", new THREE.BufferAttribute(points.slice(), 3));
      made.normalizeNormals();
    } else {
      made.computeVertexNormals(); // of triangles that share no corners: flat
    }
    return made;
  }

  function outlined(geometry, material, ink) {
    const group = new THREE.Group();
    group.add(new THREE.Mesh(geometry, material));
    if (ink) group.add(new THREE.LineSegments(new THREE.EdgesGeometry(geometry, 20), ink));
    return group;
  }

  function built(view) {
    const whole = new THREE.Group();
    const forms = view.shapes.map(geometryOf);
    const ink = new THREE.LineBasicMaterial({ color: 0x40382f });
    const pieces = view.shape.map((k, n) => {
      const paint = new THREE.MeshLambertMaterial({ color: PALETTE[n % PALETTE.length] });
      const edges = !view.shapes[k].smooth && view.shape.length <= MOST_OUTLINED;
      return outlined(forms[k], paint, edges ? ink : null);
    });
    const glass = new THREE.MeshLambertMaterial({
      color: 0x9eb0c2, transparent: true, opacity: 0.16, depthWrite: false, side: THREE.DoubleSide,
    });
    const rim = new THREE.LineBasicMaterial({ color: 0x6b7a88, transparent: true, opacity: 0.5 });
    const walls = view.walls.map((mesh) => outlined(geometryOf(mesh), glass, mesh.edges ? rim : null));
    whole.add(...pieces, ...walls);
    return {
      whole, pieces, walls, groups: view.groups, time: view.time, box: view.box,
      position: numbers(view.position), orientation: numbers(view.orientation), poses: numbers(view.wall_pose),
    };
  }

  const renderer = new THREE.WebGLRenderer({ canvas, antialias: true });
  const scene = new THREE.Scene();
  scene.background = new THREE.Color(0xffffff);
  const camera = new THREE.PerspectiveCamera(28, 1, 1e-3, 100);
  camera.up.set(0, 0, 1);
  const sun = new THREE.DirectionalLight(0xffffff, 0.55);
  sun.position.set(-0.5, 0.8, 0.6);
  camera.add(sun);
  scene.add(new THREE.HemisphereLight(0xffffff, 0xb0a89c, 0.75), camera);
  const controls = new THREE.TrackballControls(camera, canvas);
  Object.assign(controls, { rotateSpeed: 2.5, zoomSpeed: 1.0, panSpeed: 0.5, staticMoving: true });

  const made = [];
  let now = null;
  let grows = false; // whether more instants will come
  let frame = 0;
  let clock = null; // of the last picture while it plays (ms)
  let time = 0;
  let isStale = true; // whether the picture must be drawn: without a graphics card that costs a core
  controls.addEventListener("change", () => { isStale = true; });

  function resize() {
    isStale = true;
    const [width, height] = [canvas.clientWidth, canvas.clientHeight];
    renderer.setPixelRatio(window.devicePixelRatio || 1);
    renderer.setSize(width, height, false);
    camera.aspect = width / height;
    camera.updateProjectionMatrix();
    controls.handleResize();
  }

  function look() {
    const [low, high] = now.box.map((corner) => new THREE.Vector3(...corner));
    const middle = low.clone().add(high).multiplyScalar(0.5);
    const radius = 0.5 * high.distanceTo(low);
    const [azimuth, elevation] = [(25 * Math.PI) / 180, (14 * Math.PI) / 180];
    const away = (1.02 * radius) / Math.sin((camera.fov * Math.PI) / 360) / Math.min(1, camera.aspect);
    camera.position.set(Math.cos(elevation) * Math.cos(azimuth), Math.cos(elevation) * Math.sin(azimuth), Math.sin(elevation));
    camera.position.multiplyScalar(away).add(middle);
    camera.near = 0.01 * away;
    camera.far = 20 * away;
    camera.updateProjectionMatrix();
    controls.target.copy(middle);
    controls.update();
  }

  function place(body, position, orientation, p, q) {
    body.visible = Number.isFinite(position[p]) && Number.isFinite(orientation[q]);
    if (!body.visible) return;
    body.position.set(position[p], position[p + 1], position[p + 2]);
    body.quaternion.set(orientation[q + 1], orientation[q + 2], orientation[q + 3], orientation[q]);
  }

  function nearest(t) {
    let [low, high] = [0, now.time.length - 1];
    while (low < high) {
      const middle = (low + high) >> 1;
      if (now.time[middle] < t) low = middle + 1;
      else high = middle;
    }
    return low > 0 && t - now.time[low - 1] < now.time[low] - t ? low - 1 : low;
  }

  function show(i) {
    frame = i;
    isStale = true;
    const count = now.pieces.length;
    const groups = now.walls.length;
    const still = now.poses.length === 7 * groups;
    now.pieces.forEach((piece, n) => place(piece, now.position, now.orientation, 3 * (i * count + n), 4 * (i * count + n)));
    now.walls.forEach((wall, g) => {
      const at = 7 * ((still ? 0 : i) * groups + g);
      place(wall, now.poses, now.poses, at, at + 3);
    });
    slider.value = i;
    shown.textContent = `${(1e3 * now.time[i]).toFixed(1)} ms`;
    canvas.dataset.frame = i;
    for (const cursor of document.querySelectorAll(".cursor")) {
      const [start, end, left, right] = ["start", "end", "left", "right"].map((key) => Number(cursor.dataset[key]));
      const part = (now.time[i] - start) / (end - start);
      cursor.style.display = part >= 0 && part <= 1 ? "block" : "none";
      cursor.style.left = `${100 * (left + part * (right - left))}%`;
    }
  }

  function choose(k) {
    if (now) scene.remove(now.whole);
    now = made[k] = made[k] || built(views[k].view);
    scene.add(now.whole);
    slider.max = now.time.length - 1;
    choosePace(now.time[now.time.length - 1] - now.time[0]);
    look();
    time = now.time[0];
    show(0);
  }

  function choosePace(span) {
    const paces = [...pace.options].map((option) => Number(option.value));
    pace.selectedIndex = paces.findIndex((slower, n) => span * slower >= 6 || n === paces.length - 1);
  }

  // view: of the same bodies as the one that is shown, it takes its place at the instant that is shown.
  // more: whether more instants will come. span: of all instants (s). keeps: instant and camera stay as they are.
  function put(view, { plays = false, more = false, span = 0, follows = false, keeps = false } = {}) {
    grows = more;
    if (now && follows) {
      const arrays = { position: view.position, orientation: view.orientation, poses: view.wall_pose };
      for (const key of Object.keys(arrays)) now[key] = numbers(arrays[key]);
      now.time = view.time;
      slider.max = now.time.length - 1;
      show(Math.min(frame, now.time.length - 1));
      return;
    }
    const before = now && keeps ? [camera.position.clone(), controls.target.clone(), time] : null;
    views[0] = { view };
    if (now) scene.remove(now.whole);
    now = made[0] = null;
    choose(0);
    if (more) { // where pieces will be is not known yet
      const all = new THREE.Box3().setFromObject(now.whole);
      now.box = [all.min.toArray(), all.max.toArray()];
      look();
    }
    if (before) {
      camera.position.copy(before[0]);
      controls.target.copy(before[1]);
      go(before[2]);
    }
    if (span) choosePace(span);
    start(plays);
  }

  function go(t) {
    time = Math.min(t, now.time[now.time.length - 1]);
    const i = nearest(time);
    if (i !== frame || !canvas.dataset.frame) show(i);
  }

  function start(plays) {
    clock = plays ? performance.now() : null;
    play.textContent = plays ? "Pause" : "Play";
    if (plays && frame === now.time.length - 1) go(now.time[0]);
  }

  function tick(at) {
    if (clock !== null) {
      go(time + (1e-3 * Math.max(0, at - clock)) / Number(pace.value));
      clock = Math.max(at, clock);
      if (frame === now.time.length - 1 && !grows) start(false);
    }
    controls.update();
    if (isStale) renderer.render(scene, camera);
    isStale = false;
    requestAnimationFrame(tick);
  }

  play.addEventListener("click", () => now && start(clock === null));
  slider.addEventListener("input", () => { if (now) { start(false); go(now.time[Number(slider.value)]); } });
  chosen.addEventListener("change", () => { start(false); choose(Number(chosen.value)); });
  document.getElementById("again").addEventListener("click", () => { if (now) { controls.reset(); look(); } });
  window.addEventListener("resize", resize);
  resize();
  if (views.length) choose(0);
  window.dropPlayer = { put, redraw: () => { isStale = true; }, instants: () => (now ? now.time : []), world: () => ({ THREE, camera, now }) };
  const asked = /t=(-?[\d.]+)/.exec(location.hash);
  if (now && asked) go(Number(asked[1]));
  if (now && location.hash.includes("play")) start(true);
  requestAnimationFrame(tick);
})();
