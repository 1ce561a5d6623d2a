// The view in three dimensions: orthographic, turned by dragging, drawn on a canvas.
(() => {
  "use strict";
  const holder = document.getElementById("viewer");
  if (!holder) return;
  const scene = JSON.parse(document.getElementById("scene").textContent);
  const canvas = holder.querySelector("canvas"), pen = canvas.getContext("2d");
  const slider = holder.querySelector("input"), readout = holder.querySelector("output");
  const play = holder.querySelector("[data-play]");
  const RANKS = ["best", "median", "worst"];
  const state = { grid: scene.grids.length - 1, path: 0, rank: 1, azimuth: -62, elevation: 22, at: 0 };
  state.grid = Math.min(1, state.grid);

  const point = (flat, i) => [flat[3 * i], flat[3 * i + 1], flat[3 * i + 2]];
  const length = (flat) => flat.length / 3;
  const run = () => scene.grids[state.grid].runs[state.path][state.rank];
  // A knot that never moves is stored once.
  const arm = (i) => [[0, 0, 0], ...run().knots.map((k) => point(k, Math.min(i, length(k) - 1))), point(run().reached, i)];
  const corners = [0, 1, 2, 3, 4, 5, 6, 7].map((i) => [0, 1, 2].map((axis) => scene.box[(i >> axis) & 1][axis]));
  const edges = corners.flatMap((_, i) => [1, 2, 4].filter((bit) => !(i & bit)).map((bit) => [i, i | bit]));

  // Centre and size hold the box and the arm, so that nothing jumps when a grid is chosen.
  const seen = [...corners, ...scene.paths.flatMap((path, p) => scene.grids[0].runs[p][1].knots.flatMap((k) => [point(k, 0)])), [0, 0, 0]];
  const middle = [0, 1, 2].map((axis) => {
    const values = seen.map((v) => v[axis]);
    return (Math.min(...values) + Math.max(...values)) / 2;
  });
  const radius = Math.max(...seen.map((v) => Math.hypot(...v.map((c, axis) => c - middle[axis]))));

  function projection(width, height) {
    const a = (state.azimuth * Math.PI) / 180, e = (state.elevation * Math.PI) / 180;
    const scale = (0.49 * Math.min(width * 1.25, height)) / radius;
    return (v) => {
      const [x, y, z] = v.map((c, axis) => c - middle[axis]);
      const across = -Math.sin(a) * x + Math.cos(a) * y, depth = Math.cos(a) * x + Math.sin(a) * y;
      return [width / 2 + scale * across, height / 2 - scale * (Math.cos(e) * z - Math.sin(e) * depth), Math.cos(e) * depth + Math.sin(e) * z];
    };
  }

  function draw() {
    const width = canvas.clientWidth, height = canvas.clientHeight, ratio = window.devicePixelRatio || 1;
    if (!width) return;
    canvas.width = width * ratio;
    canvas.height = height * ratio;
    pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    const css = getComputedStyle(document.documentElement);
    const colour = (name) => css.getPropertyValue(`--${name}`).trim();
    const project = projection(width, height);

    const line = (points, style, weight, dash = [], breaks = []) => {
      pen.strokeStyle = colour(style);
      pen.lineWidth = weight;
      pen.setLineDash(dash);
      pen.lineJoin = pen.lineCap = dash.length ? "butt" : "round";
      pen.beginPath();
      points.forEach((v, i) => {
        const [x, y] = project(v);
        if (i === 0 || breaks.includes(i)) pen.moveTo(x, y);
        else pen.lineTo(x, y);
      });
      pen.stroke();
      pen.setLineDash([]);
    };
    const dot = (v, size, style) => {
      const [x, y] = project(v);
      pen.fillStyle = colour(style);
      pen.beginPath();
      pen.arc(x, y, size, 0, 2 * Math.PI);
      pen.fill();
    };
    const list = (flat) => Array.from({ length: length(flat) }, (_, i) => point(flat, i));
    const note = (v, words, style, dx, dy) => {
      const [x, y] = project(v);
      pen.fillStyle = colour(style);
      pen.font = `13px ${getComputedStyle(document.body).fontFamily}`;
      pen.fillText(words, x + dx, y + dy);
    };

    pen.fillStyle = colour("panel");
    pen.fillRect(0, 0, width, height);
    for (const [i, j] of edges) line([corners[i], corners[j]], "rule", 1);
    ["x", "y", "z"].forEach((name, axis) => {
      const end = scene.box[0].map((c, k) => (k === axis ? scene.box[1][k] + 5 : c));
      line([scene.box[0], end], "muted", 1);
      note(end, `${name} ${scene.box[1][axis]}`, "muted", 3, 3);
    });

    const grid = scene.grids[state.grid], path = scene.paths[state.path], chosen = run();
    const samples = list(grid.samples).sort((p, q) => project(p)[2] - project(q)[2]);
    const size = samples.length > 200 ? 1.4 : 2.4;
    for (const sample of samples) dot(sample, size, "sample");
    const pose = arm(state.at);
    line(pose, "rule", 9);
    line(pose, "muted", 5);
    pose.slice(0, -1).forEach((knot) => { dot(knot, 4.5, "muted"); dot(knot, 2.6, "panel"); });
    line(list(path.target), "target", 2, [], path.breaks);
    line(list(chosen.reached), "network", 2, [6, 3], path.breaks);
    const target = point(path.target, state.at), reached = point(chosen.reached, state.at);
    line([target, reached], "ink", 1.2);
    dot(target, 3.4, "target");
    dot(reached, 3.4, "network");

    readout.textContent = `${chosen.error[state.at].toFixed(2)} mm off here, ${chosen.max.toFixed(2)} mm at most`;
    pen.font = `13px ${getComputedStyle(document.body).fontFamily}`;
    const legend = [["target", "target"], ["network", `reached by seed ${chosen.seed}: ${chosen.mean.toFixed(2)} mm off on average`], ["sample", `${grid.n} training points`]];
    legend.forEach(([style, words], i) => {
      const y = 20 + 19 * i;
      pen.strokeStyle = pen.fillStyle = colour(style);
      pen.lineWidth = 2;
      pen.setLineDash(style === "network" ? [6, 3] : []);
      pen.beginPath();
      if (style === "sample") { pen.arc(23, y, 2.4, 0, 2 * Math.PI); pen.fill(); }
      else { pen.moveTo(12, y); pen.lineTo(34, y); pen.stroke(); }
      pen.fillStyle = colour("ink");
      pen.fillText(words, 42, y + 4.5);
    });
    pen.setLineDash([]);
    canvas.dataset.view = `${state.azimuth.toFixed(1)} ${state.elevation.toFixed(1)} ${grid.n} ${path.name} ${chosen.rank} ${state.at}`;
  }

  function choice(key, names) {
    const place = holder.querySelector(`[data-choice="${key}"]`);
    if (names.length < 2) { place.remove(); return; }
    names.forEach((name, i) => {
      const button = document.createElement("button");
      button.type = "button";
      button.textContent = name;
      button.setAttribute("aria-pressed", String(i === state[key]));
      button.addEventListener("click", () => {
        state[key] = i;
        [...place.children].forEach((other, j) => other.setAttribute("aria-pressed", String(j === i)));
        if (key === "path") rewind();
        draw();
      });
      place.append(button);
    });
  }

  function rewind() {
    slider.max = String(length(scene.paths[state.path].target) - 1);
    state.at = Math.min(state.at, Number(slider.max));
    slider.value = String(state.at);
  }

  function turn(dx, dy) {
    state.azimuth = (state.azimuth - dx) % 360;
    state.elevation = Math.max(-90, Math.min(90, state.elevation + dy));
    draw();
  }

  // Places are kept here, since not every browser reports the movement of a finger.
  let last = null;
  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    last = [event.clientX, event.clientY];
  });
  canvas.addEventListener("pointermove", (event) => {
    if (!last) return;
    turn(0.45 * (event.clientX - last[0]), 0.45 * (event.clientY - last[1]));
    last = [event.clientX, event.clientY];
  });
  for (const end of ["pointerup", "pointercancel"]) canvas.addEventListener(end, () => { last = null; });
  canvas.addEventListener("keydown", (event) => {
    const step = { ArrowLeft: [-5, 0], ArrowRight: [5, 0], ArrowUp: [0, -5], ArrowDown: [0, 5] }[event.key];
    if (!step) return;
    event.preventDefault();
    turn(...step);
  });
  slider.addEventListener("input", () => { state.at = Number(slider.value); draw(); });

  let clock = 0;
  play.addEventListener("click", () => {
    clearInterval(clock);
    clock = clock ? 0 : setInterval(() => {
      state.at = (state.at + 1) % length(scene.paths[state.path].target);
      slider.value = String(state.at);
      draw();
    }, 40);
    play.textContent = clock ? "Stop" : "Play";
  });

  choice("grid", scene.grids.map((grid) => String(grid.n)));
  choice("path", scene.paths.map((path) => path.name));
  choice("rank", scene.grids[0].runs[0].some((one, _, all) => one.seed !== all[0].seed) ? RANKS : ["median"]);
  rewind();
  draw();
  addEventListener("resize", draw);
  for (const query of ["(prefers-color-scheme: dark)", "print"]) matchMedia(query).addEventListener("change", draw);
})();
