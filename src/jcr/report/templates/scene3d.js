// The 3D view: points, cameras and grippers in the base frame (metres, z up), drawn on a plain 2D canvas with a depth
// buffer of its own, so that it needs no graphics driver and prints like any picture.
"use strict";
(() => {
  const holder = document.getElementById("scene-data");
  if (!holder) return;
  const canvas = document.getElementById("scene");
  const context = canvas.getContext("2d");
  const tooltip = document.getElementById("scene-tip");
  const photo = document.getElementById("scene-photo");
  const photoMix = document.getElementById("scene-mix");
  const lookThrough = document.getElementById("scene-through");

  const bytes = (text) => Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
  let scene, layers;
  function read() {
    scene = JSON.parse(holder.textContent);
    layers = scene.layers.map((layer) => {
      const steps = new Uint16Array(bytes(layer.xyz).buffer);
      const xyz = new Float32Array(steps.length);
      for (let i = 0; i < steps.length; i++) {
        const [low, high] = [scene.box[0][i % 3], scene.box[1][i % 3]];
        xyz[i] = low + (steps[i] / 65535) * (high - low);
      }
      return { xyz, rgb: bytes(layer.rgb), size: layer.size };
    });
  }
  read();
  const column = (matrix, k) => matrix.map((row) => row[k]);
  const add = (a, b, factor = 1) => a.map((x, k) => x + factor * b[k]);
  const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
  const apply = (matrix, x) => matrix.map((row) => dot(row, x) + row[3]);

  // What is looked at: an orbit about `target`, or (through >= 0) out of one of the cameras.
  const state = { yaw: 0, pitch: 0, distance: 1, target: [0, 0, 0], through: -1, moved: false };
  const shown = () => ({
    // The last choice is to show none; the last layer, the tracks, has a box of its own.
    layer: Number(document.querySelector('input[name="scene-layer"]:checked')?.value ?? layers.length - 1),
    tracks: document.getElementById("scene-tracks").checked,
    cameras: document.getElementById("scene-cameras").checked,
    others: document.getElementById("scene-others")?.checked,
    grippers: document.getElementById("scene-grippers").checked,
    grid: document.getElementById("scene-grid").checked,
  });

  // Right, down and forward of the eye in the base frame, its centre, and its intrinsics in canvas pixels.
  function eye() {
    const [w, h] = [canvas.width, canvas.height];
    if (state.through >= 0) {
      const camera = scene.views[state.through].camera;
      const { fx, fy, cx, cy, width, height } = scene.intrinsics;
      const zoom = Math.min(w / width, h / height);
      return {
        axes: [0, 1, 2].map((k) => column(camera, k)), center: column(camera, 3),
        fx: zoom * fx, fy: zoom * fy,
        cx: w / 2 + zoom * (cx + 0.5 - width / 2), cy: h / 2 + zoom * (cy + 0.5 - height / 2),
      };
    }
    const [sy, cy, sp, cp] = [Math.sin(state.yaw), Math.cos(state.yaw), Math.sin(state.pitch), Math.cos(state.pitch)];
    const forward = [-cp * cy, -cp * sy, -sp];
    const axes = [[-sy, cy, 0], [sp * cy, sp * sy, -cp], forward];
    const focal = 1.2 * Math.min(w, 1.3 * h);
    return { axes, center: add(state.target, forward, -state.distance), fx: focal, fy: focal, cx: w / 2, cy: h / 2 };
  }

  function project(view, x) {
    const d = add(x, view.center, -1);
    const z = dot(view.axes[2], d);
    return [view.cx + (view.fx * dot(view.axes[0], d)) / z, view.cy + (view.fy * dot(view.axes[1], d)) / z, z];
  }

  // Canvas pixels per pixel of the page.
  let ratio = 1;
  let depth = new Float32Array(0);
  function drawPoints(view, visible, picture) {
    const [w, h] = [canvas.width, canvas.height];
    const pixels = new Uint32Array(picture.data.buffer);
    if (depth.length !== w * h) depth = new Float32Array(w * h);
    depth.fill(Infinity);
    const [r, d, f] = view.axes;
    const [ex, ey, ez] = view.center;
    for (const { xyz, rgb, size } of visible) {
      for (let i = 0; i < xyz.length; i += 3) {
        const [x, y, z] = [xyz[i] - ex, xyz[i + 1] - ey, xyz[i + 2] - ez];
        const ahead = f[0] * x + f[1] * y + f[2] * z;
        if (ahead < 0.02) continue;
        const half = Math.max(0.5, Math.min(0.5 * size * view.fx / ahead, 12));
        const u = view.cx + (view.fx * (r[0] * x + r[1] * y + r[2] * z)) / ahead;
        const v = view.cy + (view.fy * (d[0] * x + d[1] * y + d[2] * z)) / ahead;
        const [left, right] = [Math.max(0, Math.round(u - half)), Math.min(w, Math.round(u + half))];
        const [top, bottom] = [Math.max(0, Math.round(v - half)), Math.min(h, Math.round(v + half))];
        if (left >= right || top >= bottom) continue;
        const nearness = Math.log(ahead);
        const color = 0xff000000 | (rgb[i + 2] << 16) | (rgb[i + 1] << 8) | rgb[i];
        for (let row = top; row < bottom; row++) {
          for (let at = row * w + left; at < row * w + right; at++) {
            if (nearness < depth[at]) { depth[at] = nearness; pixels[at] = color; }
          }
        }
      }
    }
    shade(pixels, w, h);
  }

  // Eye-dome lighting (Boucheny 2009): a pixel behind its neighbours is darkened, which shows shape without normals.
  function shade(pixels, w, h) {
    const step = Math.max(1, Math.round(ratio));
    for (let row = step; row < h - step; row++) {
      for (let at = row * w + step; at < (row + 1) * w - step; at++) {
        const here = depth[at];
        if (here === Infinity) continue;
        const behind = Math.max(0, here - depth[at - step]) + Math.max(0, here - depth[at + step])
          + Math.max(0, here - depth[at - step * w]) + Math.max(0, here - depth[at + step * w]);
        if (behind < 0.002) continue;
        const light = Math.max(0.35, Math.exp(-6 * behind));
        const c = pixels[at];
        pixels[at] = 0xff000000 | (((c >> 16) & 255) * light << 16) | (((c >> 8) & 255) * light << 8) | ((c & 255) * light);
      }
    }
  }

  function line(view, ends, color, width = 1) {
    const [a, b] = ends.map((x) => project(view, x));
    if (a[2] < 0.02 || b[2] < 0.02) return;
    context.strokeStyle = color;
    context.lineWidth = width * ratio;
    context.beginPath();
    context.moveTo(a[0], a[1]);
    context.lineTo(b[0], b[1]);
    context.stroke();
  }

  function triad(view, matrix, length, width) {
    const origin = column(matrix, 3);
    ["#e5484d", "#30a46c", "#3e7bfa"].forEach((color, k) =>
      line(view, [origin, add(origin, column(matrix, k), length)], color, width));
  }

  function drawViews(view, show, colors) {
    scene.views.forEach((image, k) => {
      if (k === state.through) return;
      const color = k === picked ? colors.accent : image.used ? colors.camera : colors.bad;
      const grip = column(image.gripper, 3);
      if (show.grippers) triad(view, image.gripper, 0.03, 1.5);
      if (!image.camera) return;
      const center = column(image.camera, 3);
      if (show.grippers && show.cameras) line(view, [grip, center], colors.faint, 1);
      if (show.cameras) frustum(view, image.camera, scene.intrinsics, color, k === picked ? 3 : 1.5);
    });
    if (show.others) scene.others.forEach(({ fixed, intrinsics, cameras }, k) => {
      const chosen = scene.views.length + k === picked;
      cameras.forEach((camera) =>
        frustum(view, camera, intrinsics, chosen ? colors.accent : colorOf(k, colors), chosen ? 3 : fixed ? 2.5 : 1.5, fixed ? 0.08 : 0.05));
    });
    if (show.others) drawNames(view, colors);
  }

  // Violet, teal, magenta, olive: none that has a meaning already.
  const colorOf = (k, colors) => `hsl(${[262, 185, 320, 75][k % 4]} 75% ${colors.light})`;

  // Behind the camera, of cameras that move once; names that would overlap are shifted down.
  function drawNames(view, colors) {
    const taken = [];
    context.font = `600 ${12 * ratio}px system-ui, sans-serif`;
    const items = scene.others.map(({ name, cameras }, k) => ({
      name, at: column(cameras[0], 3), ahead: add(column(cameras[0], 3), column(cameras[0], 2), 0.05), color: colorOf(k, colors),
    }));
    scene.bases.forEach(({ name, base }) => {
      triad(view, base, 0.1, 3);
      items.push({ name, at: column(base, 3), ahead: add(column(base, 3), column(base, 2), 0.05), color: colors.ink });
    });
    for (const { name, at, ahead, color } of items) {
      const [u, v, z] = project(view, at);
      if (z < 0.02) continue;
      const [wide, high] = [context.measureText(name).width, 15 * ratio];
      const [du, dv] = project(view, ahead).map((value, k) => [u, v][k] - value);
      const away = (10 * ratio) / Math.max(Math.hypot(du, dv), 1e-9);
      let x = u + away * du - (du < 0 ? wide : 0);
      x = Math.max(4 * ratio, Math.min(x, canvas.width - 4 * ratio - wide));
      let y = v + away * dv + (dv > 0 ? 8 : 0) * ratio;
      while (taken.some((box) => Math.abs(box.y - y) < high && x < box.x + box.wide && box.x < x + wide)) y += high;
      taken.push({ x, y, wide });
      context.strokeStyle = colors.paper;
      context.lineWidth = 3 * ratio;
      context.lineJoin = "round";
      context.strokeText(name, x, y);
      context.fillStyle = color;
      context.fillText(name, x, y);
    }
  }

  function frustum(view, camera, intrinsics, color, thick, reach = 0.05) {
    const { fx, fy, cx, cy, width, height } = intrinsics;
    const center = column(camera, 3);
    const corners = [[0, 0], [width, 0], [width, height], [0, height]].map(([u, v]) =>
      apply(camera, [(reach * (u - 0.5 - cx)) / fx, (reach * (v - 0.5 - cy)) / fy, reach]));
    corners.forEach((corner, i) => {
      line(view, [center, corner], color, thick);
      line(view, [corner, corners[(i + 1) % 4]], color, thick);
    });
  }

  function drawGrid(view, colors) {
    const size = Math.max(...[0, 1].map((k) => scene.box[1][k] - scene.box[0][k]));
    let step = 0.1;
    while (size > 60 * step) step *= 10;
    const [low, high] = scene.box.map((corner, end) =>
      corner.map((x) => step * (end ? Math.ceil(Math.max(x, step) / step) : Math.floor(Math.min(x, -step) / step))));
    for (let x = low[0]; x <= high[0] + 1e-6; x += step) line(view, [[x, low[1], 0], [x, high[1], 0]], colors.faint, 0.5);
    for (let y = low[1]; y <= high[1] + 1e-6; y += step) line(view, [[low[0], y, 0], [high[0], y, 0]], colors.faint, 0.5);
    triad(view, [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]], 0.1, 3);
    const [u, v, z] = project(view, [0, 0, 0]);
    if (z < 0.02) return;
    context.fillStyle = colors.ink;
    context.font = `${12 * ratio}px system-ui, sans-serif`;
    context.fillText("base", u + 6 * ratio, v + 14 * ratio);
  }

  let picked = -1;
  function draw() {
    const show = shown();
    const view = eye();
    const style = getComputedStyle(canvas);
    const colors = Object.fromEntries(["ink", "paper", "faint", "camera", "light", "accent", "bad"].map((name) =>
      [name, style.getPropertyValue(`--scene-${name}`).trim()]));
    context.clearRect(0, 0, canvas.width, canvas.height);
    const picture = context.createImageData(canvas.width, canvas.height);
    const visible = [];
    if (show.layer < layers.length - 1) visible.push(layers[show.layer]);
    if (show.tracks) visible.push(layers[layers.length - 1]);
    drawPoints(view, visible, picture);
    context.putImageData(picture, 0, 0);
    if (state.through < 0) {
      if (show.grid) drawGrid(view, colors);
      drawViews(view, show, colors);
    }
    placePhoto(view);
  }

  // The photograph lies exactly on what the camera sees; the slider mixes the two.
  function placePhoto(view) {
    const through = state.through >= 0;
    photo.hidden = photoMix.parentElement.hidden = !through;
    if (!through) return;
    const { width, height, cx, cy } = scene.intrinsics;
    const zoom = view.fx / scene.intrinsics.fx / ratio;
    const [left, top] = [view.cx / ratio - zoom * (cx + 0.5), view.cy / ratio - zoom * (cy + 0.5)];
    Object.assign(photo.style, {
      left: `${left}px`, top: `${top}px`, width: `${zoom * width}px`, height: `${zoom * height}px`,
      opacity: photoMix.value / 100,
    });
    const source = document.getElementById(`image-${state.through}`);
    if (source && photo.src !== source.src) photo.src = source.src;
  }

  let waiting = 0;
  const redraw = () => { cancelAnimationFrame(waiting); waiting = requestAnimationFrame(draw); };

  function look(yawDeg, pitchDeg) {
    state.yaw = (yawDeg * Math.PI) / 180;
    state.pitch = (pitchDeg * Math.PI) / 180;
    fit();
  }

  // Far enough that the cameras and nearly all points are in the picture, whatever the direction.
  function fit() {
    setThrough(-1);
    const important = scene.views.flatMap((view) => [view.gripper, view.camera].filter(Boolean).map((m) => column(m, 3)));
    important.push([0, 0, 0], ...scene.others.flatMap(({ cameras }) => cameras.map((m) => column(m, 3))));
    important.push(...scene.bases.map(({ base }) => column(base, 3)));
    const points = [];
    for (const { xyz } of layers.slice(0, 1)) {
      const stride = 3 * Math.max(1, Math.floor(xyz.length / 3 / 500));
      for (let i = 0; i < xyz.length; i += stride) points.push([xyz[i], xyz[i + 1], xyz[i + 2]]);
    }
    const all = [...important, ...points];
    state.target = [0, 1, 2].map((k) => {
      const values = all.map((x) => x[k]).sort((a, b) => a - b);
      return (values[Math.floor(0.02 * values.length)] + values[Math.floor(0.98 * (values.length - 1))]) / 2;
    });
    state.distance = 0;
    const view = eye();
    const needed = (x) => {
      const d = add(x, state.target, -1);
      const across = Math.max((Math.abs(dot(view.axes[0], d)) * view.fx) / canvas.width,
        (Math.abs(dot(view.axes[1], d)) * view.fy) / canvas.height);
      return 2.15 * across - dot(view.axes[2], d);
    };
    const distances = points.map(needed).sort((a, b) => a - b);
    const most = distances[Math.floor(0.97 * distances.length)] ?? 0;
    state.distance = Math.max(0.1, most, ...important.map(needed));
    redraw();
  }

  function setThrough(k) {
    state.through = k;
    lookThrough.value = String(k);
    if (k >= 0) tooltip.hidden = true;
    redraw();
  }

  function turn(dx, dy) {
    state.moved = true;
    if (state.through >= 0) fit();
    state.yaw -= dx * 0.008;
    state.pitch = Math.max(-1.55, Math.min(1.57, state.pitch + dy * 0.008));
    redraw();
  }

  function move(dx, dy) {
    state.moved = true;
    const view = eye();
    const metres = (state.distance * ratio) / view.fx;
    state.target = add(add(state.target, view.axes[0], -dx * metres), view.axes[1], -dy * metres);
    redraw();
  }

  function zoom(factor) {
    state.moved = true;
    state.distance = Math.max(0.05, Math.min(20, state.distance * factor));
    redraw();
  }

  function pick(event) {
    const box = canvas.getBoundingClientRect();
    const [u, v] = [event.clientX - box.left, event.clientY - box.top];
    const view = eye();
    let [best, nearest] = [-1, 18];
    const others = shown().others ? scene.others.map(({ cameras }) => cameras) : [];
    const pickable = [...scene.views.map(({ camera, gripper }) => [camera, gripper].filter(Boolean)), ...others];
    if (state.through < 0) pickable.forEach((matrices, k) => matrices.forEach((matrix) => {
      const [x, y, z] = project(view, column(matrix, 3));
      const away = Math.hypot(x / ratio - u, y / ratio - v);
      if (z > 0 && away < nearest) [best, nearest] = [k, away];
    }));
    if (best !== picked) { picked = best; redraw(); }
    tooltip.hidden = best < 0;
    if (best < 0) return;
    const { name, caption } = scene.views[best] ?? scene.others[best - scene.views.length];
    tooltip.textContent = `${name}\n${caption}`;
    tooltip.style.left = `${Math.min(u + 14, Math.max(0, box.width - tooltip.offsetWidth - 6))}px`;
    tooltip.style.top = `${Math.max(4, v - tooltip.offsetHeight - 10)}px`;
  }

  const fingers = new Map();
  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    canvas.focus({ preventScroll: true });
    fingers.set(event.pointerId, event);
    pick(event);
  });
  canvas.addEventListener("pointermove", (event) => {
    const before = fingers.get(event.pointerId);
    if (!before) { if (event.pointerType === "mouse") pick(event); return; }
    const [dx, dy] = [event.clientX - before.clientX, event.clientY - before.clientY];
    if (fingers.size === 1) {
      if (event.shiftKey || (event.buttons & 6)) move(dx, dy); else turn(dx, dy);
    } else {
      const other = [...fingers.values()].find((finger) => finger.pointerId !== event.pointerId);
      const span = (finger) => Math.hypot(finger.clientX - other.clientX, finger.clientY - other.clientY);
      zoom(span(before) / Math.max(1, span(event)));
      move(dx / 2, dy / 2);
    }
    fingers.set(event.pointerId, event);
    tooltip.hidden = true;
  });
  for (const end of ["pointerup", "pointercancel"]) {
    canvas.addEventListener(end, (event) => fingers.delete(event.pointerId));
  }
  canvas.addEventListener("pointerleave", (event) => {
    if (event.pointerType !== "mouse") return;
    picked = -1;
    tooltip.hidden = true;
    redraw();
  });
  canvas.addEventListener("contextmenu", (event) => event.preventDefault());
  // The page scrolls over the view until the reader has clicked into it.
  canvas.addEventListener("wheel", (event) => {
    if (document.activeElement !== canvas && !event.ctrlKey) return;
    event.preventDefault();
    zoom(Math.exp(0.0012 * event.deltaY));
  }, { passive: false });
  const keys = {
    ArrowLeft: () => turn(-12, 0), ArrowRight: () => turn(12, 0), ArrowUp: () => turn(0, -12), ArrowDown: () => turn(0, 12),
    "+": () => zoom(0.9), "-": () => zoom(1.1), Escape: () => canvas.blur(),
  };
  canvas.addEventListener("keydown", (event) => {
    if (!keys[event.key]) return;
    event.preventDefault();
    keys[event.key]();
  });

  document.querySelectorAll("[data-look]").forEach((button) =>
    button.addEventListener("click", () => look(...JSON.parse(button.dataset.look))));
  document.querySelectorAll("[data-through]").forEach((button) =>
    button.addEventListener("click", () => {
      setThrough(Number(button.dataset.through));
      canvas.scrollIntoView({ block: "center", behavior: "smooth" });
    }));
  lookThrough.addEventListener("change", () => (lookThrough.value === "-1" ? fit() : setThrough(Number(lookThrough.value))));
  document.getElementById("scene-controls").addEventListener("input", redraw);
  // The live page puts new content there.
  holder.addEventListener("change", () => { read(); if (state.moved) redraw(); else fit(); });
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", redraw);

  new ResizeObserver(() => {
    ratio = Math.min(devicePixelRatio, 2);
    const [w, h] = [canvas.clientWidth, canvas.clientHeight].map((x) => Math.round(x * ratio));
    if (!w || !h || (canvas.width === w && canvas.height === h)) return;
    const first = !canvas.dataset.ready;
    [canvas.width, canvas.height] = [w, h];
    canvas.dataset.ready = "yes";
    if (first) look(-50, 30); else draw();
  }).observe(canvas);
})();
