// The report's view of the wing in 3-D. Data: reconstruct/wing_view.py. Body frame: x aft, y to the right wing, z up; metres.
"use strict";

(() => {
  const UNKNOWN = -32768;
  const GHOST = "#8f969d", INK = "#3c4349", FAINT = "#dfe3e6";
  const SCALE = [[255, 240, 196], [244, 165, 66], [180, 40, 30]]; // of residuals: small, middle, large
  const PLAYED_S = 30; // a track that is longer is played faster

  const element = (name) => document.getElementById(`wing-${name}`);
  const data = JSON.parse(element("data").textContent);
  const canvas = element("canvas"), trace = element("trace"), slider = element("time");

  // ---- data

  function bytes(text) {
    return Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0)).buffer;
  }

  function places(text, step) {
    return Float32Array.from(new Int16Array(bytes(text)), (whole) => (whole === UNKNOWN ? NaN : whole * step));
  }

  const floats = (text) => new Float32Array(bytes(text));
  const each = (object, change) => Object.fromEntries(Object.entries(object).map(([key, value]) => [key, change(value)]));

  for (const side of data.sides) {
    side.rest = places(side.rest, data.step_m);
    side.marker_station = floats(side.marker_station);
    side.marker_across = floats(side.marker_across);
  }
  for (const track of data.tracks) {
    track.time_s = floats(track.time_s);
    track.signals = each(track.signals, floats);
    for (const [name, side] of Object.entries(track.sides)) {
      const { edges, markers, residual, ...readings } = side;
      track.sides[name] = {
        edges: places(edges, data.step_m), markers: places(markers, data.step_m),
        residual: places(residual, data.residual_step_mm), ...each(readings, floats),
      };
    }
  }

  // ---- what is shown

  const HOME = { yaw: -22, pitch: 16, zoom: 1 };
  const view = { ...HOME };
  const state = { track: data.tracks[data.tracks.length - 1], frame: 0, exaggeration: 1, playing: false, speed: 1 };
  const box = bounds();

  function bounds() {
    const low = [Infinity, Infinity, Infinity], high = [-Infinity, -Infinity, -Infinity];
    const include = (points) => points.forEach((value, at) => {
      low[at % 3] = Math.min(low[at % 3], isNaN(value) ? Infinity : value);
      high[at % 3] = Math.max(high[at % 3], isNaN(value) ? -Infinity : value);
    });
    data.sides.forEach((side) => include(side.rest));
    data.tracks.forEach((track) => Object.values(track.sides).forEach((side) => include(side.edges)));
    return { middle: low.map((value, at) => (value + high[at]) / 2), half: low.map((value, at) => (high[at] - value) / 2) };
  }

  // The wing of a set, displacements exaggerated about the reference: edges (S × 2 × 3) and markers (M × 3).
  function wing(side) {
    const now = state.track.sides[side.name], k = state.exaggeration;
    const edges = now.edges.subarray(state.frame * side.rest.length, (state.frame + 1) * side.rest.length);
    const count = side.markers.length;
    const markers = now.markers.subarray(state.frame * count * 3, (state.frame + 1) * count * 3);
    const residual = now.residual.subarray(state.frame * count, (state.frame + 1) * count);
    if (k === 1) return { edges, markers, residual };
    const moved = markers.map((value, at) => value + (k - 1) * displacement(side, edges, Math.floor(at / 3), at % 3));
    return { edges: edges.map((value, at) => side.rest[at] + k * (value - side.rest[at])), markers: moved, residual };
  }

  // How far the strip has moved where a marker is, along one axis.
  function displacement(side, edges, marker, axis) {
    const station = side.marker_station[marker], across = side.marker_across[marker];
    const inner = Math.min(Math.floor(station), side.stations - 2), part = station - inner;
    const at = (row, edge) => edges[row * 6 + edge * 3 + axis] - side.rest[row * 6 + edge * 3 + axis];
    const along = (edge) => (1 - part) * at(inner, edge) + part * at(inner + 1, edge);
    return (1 - across) * along(0) + across * along(1);
  }

  // ---- projection: the eye looks at the middle of the box from (yaw, pitch), perspective weak

  let eye = null;

  function look(width, height) {
    const yaw = view.yaw * Math.PI / 180, pitch = view.pitch * Math.PI / 180;
    const [c, s, cp, sp] = [Math.cos(yaw), Math.sin(yaw), Math.cos(pitch), Math.sin(pitch)];
    const right = [-s, c, 0], up = [-sp * c, -sp * s, cp], toward = [cp * c, cp * s, sp];
    const reach = (axis) => axis.reduce((sum, value, at) => sum + Math.abs(value) * box.half[at], 0);
    const fit = Math.min(0.45 * width / Math.max(reach(right), 0.1), 0.4 * height / Math.max(reach(up), 0.1));
    eye = { right, up, toward, scale: fit * view.zoom, x: width / 2, y: height / 2, distance: 6 * Math.hypot(...box.half) };
  }

  function project(x, y, z) {
    const d = [x - box.middle[0], y - box.middle[1], z - box.middle[2]];
    const dot = (axis) => axis[0] * d[0] + axis[1] * d[1] + axis[2] * d[2];
    const depth = dot(eye.toward), size = eye.scale * eye.distance / (eye.distance - depth);
    return [eye.x + size * dot(eye.right), eye.y - size * dot(eye.up), depth];
  }

  // ---- drawing

  function prepare(target) {
    const ratio = window.devicePixelRatio || 1;
    const { width, height } = target.getBoundingClientRect();
    if (target.width !== Math.round(width * ratio) || target.height !== Math.round(height * ratio)) {
      target.width = Math.round(width * ratio);
      target.height = Math.round(height * ratio);
    }
    const pen = target.getContext("2d");
    pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    pen.clearRect(0, 0, width, height);
    pen.font = '12px "Helvetica Neue", Arial, "DejaVu Sans", sans-serif';
    pen.lineJoin = "round";
    return { pen, width, height };
  }

  function path(pen, points) {
    pen.beginPath();
    points.forEach(([x, y], at) => (at ? pen.lineTo(x, y) : pen.moveTo(x, y)));
  }

  const corner = (edges, row, edge) => project(edges[row * 6 + edge * 3], edges[row * 6 + edge * 3 + 1], edges[row * 6 + edge * 3 + 2]);

  function outline(edges, stations) {
    const rows = [...Array(stations).keys()];
    return [...rows.map((row) => corner(edges, row, 0)), ...rows.reverse().map((row) => corner(edges, row, 1))];
  }

  function tinted(colour, light) {
    const parts = [1, 3, 5].map((at) => parseInt(colour.slice(at, at + 2), 16));
    return `rgb(${parts.map((part) => Math.round(light > 0 ? part + (255 - part) * light : part * (1 + light))).join(",")})`;
  }

  // The strip between two stations, lighter where it faces up to the eye.
  function quads(side, edges) {
    const found = [];
    for (let row = 0; row + 1 < side.stations; row++) {
      const points = [corner(edges, row, 0), corner(edges, row + 1, 0), corner(edges, row + 1, 1), corner(edges, row, 1)];
      const [a, b, d] = [points[0], points[1], points[3]];
      const area = (b[0] - a[0]) * (d[1] - a[1]) - (b[1] - a[1]) * (d[0] - a[0]);
      const facing = Math.abs(area) / (Math.hypot(b[0] - a[0], b[1] - a[1]) * Math.hypot(d[0] - a[0], d[1] - a[1]) + 1e-9);
      found.push({ points, depth: (a[2] + points[2][2]) / 2, colour: tinted(side.colour, 0.18 + 0.34 * facing) });
    }
    return found;
  }

  function residualColour(value) {
    const at = 2 * Math.min(1, value / data.residual_top_mm), low = Math.min(1, Math.floor(at)), part = at - low;
    return `rgb(${SCALE[low].map((from, k) => Math.round(from + (SCALE[low + 1][k] - from) * part)).join(",")})`;
  }

  function drawMarkers(pen, shown) {
    for (let marker = 0; marker < shown.residual.length; marker++) {
      const [x, y, z] = shown.markers.subarray(3 * marker, 3 * marker + 3);
      if (isNaN(x)) continue;
      const [u, v] = project(x, y, z), value = shown.residual[marker];
      pen.beginPath();
      pen.arc(u, v, 3.6, 0, 2 * Math.PI);
      pen.fillStyle = isNaN(value) ? "#fff" : residualColour(value);
      pen.fill();
      pen.lineWidth = 1;
      pen.strokeStyle = INK;
      pen.stroke();
    }
  }

  function drawAxes(pen, height) {
    const origin = [44, height - 44];
    for (const [axis, name] of [[0, "x aft"], [1, "y right"], [2, "z up"]]) {
      const tip = [origin[0] + 30 * eye.right[axis], origin[1] - 30 * eye.up[axis]];
      path(pen, [origin, tip]);
      pen.strokeStyle = "#9aa2a9";
      pen.lineWidth = 1.2;
      pen.stroke();
      if (Math.hypot(tip[0] - origin[0], tip[1] - origin[1]) < 8) continue;
      pen.fillStyle = "#78828a";
      pen.textAlign = tip[0] < origin[0] - 4 ? "right" : "left";
      pen.fillText(name, tip[0] + (tip[0] < origin[0] - 4 ? -4 : 4), tip[1] + (tip[1] > origin[1] + 2 ? 11 : 2));
    }
  }

  // A length to compare with, in the plane through the middle, and what the markers' colours mean.
  function drawKey(pen, width, height) {
    const metres = [5, 2, 1, 0.5, 0.2, 0.1, 0.05, 0.02, 0.01].find((length) => length * eye.scale < 150) || 0.01;
    const [right, bottom] = [width - 20, height - 20];
    path(pen, [[right - metres * eye.scale, bottom], [right, bottom]]);
    pen.strokeStyle = INK;
    pen.lineWidth = 2;
    pen.stroke();
    pen.fillStyle = "#56606a";
    pen.textAlign = "right";
    pen.fillText(metres < 1 ? `${Math.round(metres * 100)} cm` : `${metres} m`, right, bottom - 7);
    const bar = pen.createLinearGradient(20, 0, 140, 0);
    SCALE.forEach((_, at) => bar.addColorStop(at / 2, residualColour(at / 2 * data.residual_top_mm)));
    pen.fillStyle = bar;
    pen.fillRect(20, 30, 120, 7);
    pen.fillStyle = "#56606a";
    pen.textAlign = "left";
    pen.fillText("marker to fitted wing", 20, 22);
    pen.fillText("0", 20, 52);
    pen.textAlign = "right";
    pen.fillText(`${data.residual_top_mm.toPrecision(2)} mm`, 140, 52);
  }

  function drawWing() {
    const { pen, width, height } = prepare(canvas);
    look(width, height);
    const shown = data.sides.map(wing), strips = [];
    data.sides.forEach((side, at) => {
      path(pen, outline(side.rest, side.stations));
      pen.closePath();
      pen.fillStyle = "rgba(143,150,157,0.10)";
      pen.fill();
      pen.strokeStyle = GHOST;
      pen.lineWidth = 1;
      pen.setLineDash([4, 3]);
      pen.stroke();
      pen.setLineDash([]);
      if (!isNaN(shown[at].edges[0])) strips.push(...quads(side, shown[at].edges));
    });
    for (const { points, colour } of strips.sort((one, other) => one.depth - other.depth)) {
      path(pen, points);
      pen.closePath();
      pen.fillStyle = pen.strokeStyle = colour;
      pen.lineWidth = 0.8; // no gaps between neighbours
      pen.fill();
      pen.stroke();
    }
    data.sides.forEach((side, at) => {
      if (!isNaN(shown[at].edges[0])) {
        path(pen, outline(shown[at].edges, side.stations));
        pen.closePath();
        pen.strokeStyle = side.colour;
        pen.lineWidth = 1.4;
        pen.stroke();
      }
      drawMarkers(pen, shown[at]);
    });
    drawAxes(pen, height);
    drawKey(pen, width, height);
    canvas.dataset.frame = state.frame;
  }

  // ---- the tips in time

  const MARGIN = { left: 52, right: 10, top: 16, bottom: 18 };

  function timeAt(track, x, width) {
    const [begin, end] = [track.time_s[0], track.time_s[track.time_s.length - 1]];
    return begin + (end - begin) * Math.min(1, Math.max(0, (x - MARGIN.left) / (width - MARGIN.left - MARGIN.right)));
  }

  function drawTrace() {
    const { pen, width, height } = prepare(trace);
    const track = state.track, times = track.time_s, last = times.length - 1;
    const values = data.sides.flatMap((side) => Array.from(track.sides[side.name].tip_mm)).filter((value) => !isNaN(value));
    if (!values.length) return;
    const [low, high] = [Math.min(...values), Math.max(...values)];
    const across = (time) => MARGIN.left + (width - MARGIN.left - MARGIN.right) * (times[last] > times[0] ? (time - times[0]) / (times[last] - times[0]) : 0.5);
    const down = (value) => MARGIN.top + (height - MARGIN.top - MARGIN.bottom) * (high > low ? (high - value) / (high - low) : 0.5);
    pen.fillStyle = "#78828a";
    pen.textAlign = "right";
    for (const value of [low, high]) {
      pen.fillText(value.toFixed(0), MARGIN.left - 8, down(value) + 4);
      path(pen, [[MARGIN.left, down(value)], [width - MARGIN.right, down(value)]]);
      pen.strokeStyle = FAINT;
      pen.lineWidth = 1;
      pen.stroke();
    }
    pen.textAlign = "left";
    pen.fillText("tip up, mm", MARGIN.left, 10);
    pen.fillText(`${times[0].toFixed(1)} s`, MARGIN.left, height - 4);
    pen.textAlign = "right";
    pen.fillText(`${times[last].toFixed(1)} s`, width - MARGIN.right, height - 4);
    for (const side of data.sides) {
      pen.beginPath();
      let drawing = false;
      track.sides[side.name].tip_mm.forEach((value, at) => {
        if (!isNaN(value)) pen[drawing ? "lineTo" : "moveTo"](across(times[at]), down(value));
        drawing = !isNaN(value);
      });
      pen.strokeStyle = side.colour;
      pen.lineWidth = 1.3;
      pen.stroke();
    }
    const now = across(times[state.frame]);
    path(pen, [[now, MARGIN.top - 4], [now, height - MARGIN.bottom + 4]]);
    pen.strokeStyle = INK;
    pen.lineWidth = 1;
    pen.stroke();
    for (const side of data.sides) {
      const value = track.sides[side.name].tip_mm[state.frame];
      if (isNaN(value)) continue;
      pen.beginPath();
      pen.arc(now, down(value), 3.2, 0, 2 * Math.PI);
      pen.fillStyle = side.colour;
      pen.fill();
    }
  }

  // ---- numbers

  function number(value, digits, unit) {
    return isNaN(value) ? "–" : `${value.toFixed(digits).replace("-", "−")} ${unit}`.trim();
  }

  function row(...cells) {
    const line = document.createElement("tr");
    for (const text of cells) line.appendChild(document.createElement("td")).textContent = text;
    return line;
  }

  function drawReadings() {
    const table = document.createElement("table"), head = table.createTHead().insertRow();
    for (const text of ["", "tip up", "± 2σ", "tip twist, nose-up", "± 2σ", "residual"]) {
      head.appendChild(document.createElement("th")).textContent = text;
    }
    const body = table.createTBody();
    for (const side of data.sides) {
      const now = state.track.sides[side.name], at = state.frame;
      const line = row(
        side.name, number(now.tip_mm[at], 1, "mm"), number(2 * now.tip_sigma_mm[at], 1, "mm"), number(now.twist_deg[at], 2, "°"),
        number(2 * now.twist_sigma_deg[at], 2, "°"), number(now.rms_mm[at], 2, "mm RMS"),
      );
      line.firstChild.style.color = side.colour;
      body.appendChild(line);
    }
    const signals = Object.entries(state.track.signals);
    const beside = document.createElement("p");
    beside.textContent = signals.map(([name, values]) => `${name.replaceAll("_", " ")} ${number(values[state.frame], 2, "")}`).join("   ·   ");
    element("readings").replaceChildren(table, ...(signals.length ? [beside] : []));
    element("now").textContent = number(state.track.time_s[state.frame], 2, "s");
  }

  // ---- control

  let asked = false;

  function draw() {
    if (asked) return;
    asked = true;
    requestAnimationFrame(() => {
      asked = false;
      drawWing();
      drawTrace();
      drawReadings();
    });
  }

  function show(frame) {
    state.frame = Math.min(Math.max(0, frame), state.track.time_s.length - 1);
    slider.value = state.frame;
    draw();
  }

  function nearest(time) {
    const times = state.track.time_s;
    let low = 0, high = times.length - 1;
    while (high - low > 1) {
      const middle = (low + high) >> 1;
      if (times[middle] <= time) low = middle;
      else high = middle;
    }
    return time - times[low] <= times[high] - time ? low : high;
  }

  let playedAt = 0, playedTime = 0;

  function play(on) {
    state.playing = on;
    element("play").textContent = on ? "❚❚" : "▶";
    element("play").setAttribute("aria-label", on ? "Pause" : "Play");
    if (!on) return;
    if (state.frame === state.track.time_s.length - 1) show(0);
    playedAt = performance.now();
    playedTime = state.track.time_s[state.frame];
    requestAnimationFrame(step);
  }

  function step(now) {
    if (!state.playing) return;
    const times = state.track.time_s, last = times[times.length - 1];
    const haste = Math.max(1, (last - times[0]) / PLAYED_S) * state.speed;
    playedTime += haste * (now - playedAt) / 1000;
    playedAt = now;
    show(nearest(Math.min(playedTime, last)));
    if (playedTime >= last) play(false);
    else requestAnimationFrame(step);
  }

  function choose(track) {
    play(false);
    state.track = track;
    slider.max = track.time_s.length - 1;
    const tips = data.sides.map((side) => track.sides[side.name].tip_mm);
    const highest = tips[0].reduce((best, value, at) => (value > (tips[0][best] ?? -Infinity) || isNaN(tips[0][best]) ? at : best), 0);
    show(highest);
  }

  data.tracks.forEach((track, at) => {
    const length = track.time_s[track.time_s.length - 1] - track.time_s[0];
    const option = new Option(`${track.name}, ${length.toFixed(1)} s`, at);
    element("track").add(option);
  });
  element("track").value = data.tracks.length - 1;
  element("track").onchange = (event) => choose(data.tracks[event.target.value]);
  element("exaggeration").onchange = (event) => { state.exaggeration = Number(event.target.value); draw(); };
  element("speed").onchange = (event) => { state.speed = Number(event.target.value); };
  element("play").onclick = () => play(!state.playing);
  slider.oninput = () => { play(false); show(Number(slider.value)); };
  for (const button of element("views").children) {
    button.onclick = () => { Object.assign(view, { yaw: Number(button.dataset.yaw), pitch: Number(button.dataset.pitch) }); draw(); };
  }

  // ---- hand and wheel

  const fingers = new Map();
  let apart = 0;

  canvas.onpointerdown = (event) => { fingers.set(event.pointerId, event); canvas.setPointerCapture(event.pointerId); apart = 0; };
  canvas.onpointerup = canvas.onpointercancel = (event) => { fingers.delete(event.pointerId); apart = 0; };
  canvas.onpointermove = (event) => {
    const before = fingers.get(event.pointerId);
    if (!before) return;
    fingers.set(event.pointerId, event);
    if (fingers.size === 1) {
      view.yaw -= 0.4 * (event.clientX - before.clientX);
      view.pitch = Math.min(89.9, Math.max(-89.9, view.pitch + 0.4 * (event.clientY - before.clientY)));
    } else {
      const [one, other] = [...fingers.values()];
      const now = Math.hypot(one.clientX - other.clientX, one.clientY - other.clientY);
      if (apart) zoom(now / apart);
      apart = now;
    }
    draw();
  };
  canvas.onwheel = (event) => { event.preventDefault(); zoom(Math.exp(-0.0015 * event.deltaY)); };
  canvas.ondblclick = () => { Object.assign(view, HOME); draw(); };
  trace.onpointerdown = trace.onpointermove = (event) => {
    if (!event.buttons) return;
    play(false);
    show(nearest(timeAt(state.track, event.offsetX, trace.getBoundingClientRect().width)));
  };

  function zoom(factor) {
    view.zoom = Math.min(20, Math.max(0.5, view.zoom * factor));
    draw();
  }

  new ResizeObserver(draw).observe(canvas);
  choose(state.track);
})();
