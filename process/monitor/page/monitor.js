"use strict";

// Asks for the status twice a second and shows it. What is not heard for 2 s is NO-GO, whatever was shown before.
const PERIOD_MS = 500;
const PICTURE_PERIOD_MS = 1000;
const SILENT_MS = 2000;
const OLD_PICTURE_S = 3;
const byId = (id) => document.getElementById(id);
let heardMs = performance.now();
let latest = null;
let pictures = {};

function show(node, text) {
  if (node.textContent !== text) node.textContent = text;
}

function list(node, notices) {
  const key = JSON.stringify(notices);
  if (node.dataset.key === key) return; // else a screen reader would read it out twice a second
  node.dataset.key = key;
  node.replaceChildren(...notices.map(({ name, message }) => {
    const item = document.createElement("li");
    const who = document.createElement("b");
    who.textContent = name;
    item.append(who, message);
    return item;
  }));
}

function verdict(go, reasons) {
  const header = byId("verdict");
  header.className = go ? "go" : "nogo";
  show(byId("word"), go ? "✔ GO" : "✖ NO-GO");
  document.title = go ? "GO" : "NO-GO";
  list(byId("reasons"), reasons);
}

const number = (value, digits = 0) => value === null || value === undefined ? "–" : value.toFixed(digits);

function duration(seconds) {
  const whole = Math.floor(seconds);
  const part = (value) => String(value).padStart(2, "0");
  return `${Math.floor(whole / 3600)}:${part(Math.floor(whole / 60) % 60)}:${part(whole % 60)}`;
}

function ptp(offsetNs) {
  if (offsetNs === null) return "–";
  const size = Math.abs(offsetNs);
  if (size < 1e4) return `${offsetNs.toFixed(0)} ns`;
  return size < 1e7 ? `${(offsetNs / 1e3).toFixed(0)} µs` : `${(offsetNs / 1e6).toFixed(0)} ms`;
}

function summary(status) {
  const health = status.health;
  const minutes = health.disks.map((disk) => disk.minutes_left).filter((value) => value !== null);
  const temperatures = [...Object.values(health.temperatures_c), ...health.cameras.map((camera) => camera.temperature_c)]
    .filter((value) => value !== null);
  const lost = health.cameras.flatMap((camera) => Object.values(camera.lost)).reduce((sum, count) => sum + count, 0);
  show(byId("state"), health.state);
  show(byId("triggers"), String(health.triggers));
  show(byId("time"), duration(health.recording_s));
  show(byId("lost"), String(lost));
  show(byId("disk"), minutes.length ? number(Math.min(...minutes)) : "–");
  show(byId("ptp"), ptp(status.ptp_offset_ns));
  show(byId("temperature"), temperatures.length ? `${number(Math.max(...temperatures))} °C` : "–");
  show(byId("flight"), health.flight);
  show(byId("software"), `wingshape ${health.software}`);
}

function card(place) {
  const id = `camera-${place.replace("/", "-")}`;
  let article = byId(id);
  if (!article) {
    article = byId("camera").content.firstElementChild.cloneNode(true);
    article.id = id;
    article.querySelector("h2").textContent = place;
    article.querySelector("img").alt = `latest frame of ${place}, found markers ringed`;
    byId("cameras").append(article);
  }
  return article;
}

function cameras(status) {
  const bad = new Set(status.reasons.map((reason) => reason.name));
  const shown = new Set();
  for (const camera of status.health.cameras) {
    const place = `${camera.side}/${camera.name}`;
    const picture = status.pictures[place];
    const article = card(place);
    shown.add(article.id);
    const put = (part, text) => show(article.querySelector(`.${part}`), text);
    article.classList.toggle("bad", bad.has(place));
    put("rate", `${number(camera.rate_hz, 1)} Hz`);
    put("lost", String(Object.values(camera.lost).reduce((sum, count) => sum + count, 0)));
    const bright = picture && picture.saturated_markers ? `, ${picture.saturated_markers} sat.` : "";
    put("markers", picture ? `${picture.markers}${bright}` : "–");
    put("saturated", picture ? `${(100 * picture.saturated_share).toFixed(2)} %` : "–");
    put("temperature", camera.temperature_c === null ? "–" : `${number(camera.temperature_c)} °C`);
    put("old", !picture ? "no picture" : picture.age_s > OLD_PICTURE_S ? `picture is ${number(picture.age_s)} s old` : "");
    const ring = article.querySelector(".ring");
    ring.value = camera.ring_in_use / camera.ring_slots;
    ring.title = `${camera.ring_in_use} of ${camera.ring_slots}`;
  }
  for (const article of [...byId("cameras").children]) if (!shown.has(article.id)) article.remove();
}

function parts(status) {
  const level = ["ok", "caution", "NO-GO", "stale"];
  byId("parts").replaceChildren(...status.health.diagnostics.map((part) => {
    const row = document.createElement("tr");
    const values = Object.entries(part.values).map(([name, value]) => `${name} ${value}`).join(" · ");
    for (const text of [part.name, level[part.level], part.message, values]) row.insertCell().textContent = text;
    return row;
  }));
}

function controls(status) {
  const refusal = status.control.refusal;
  const state = status.health === null ? "" : status.health.state;
  byId("start").disabled = refusal !== null || state !== "idle";
  byId("stop").disabled = refusal !== null || !["armed", "test burst", "recording"].includes(state);
  show(byId("control-note"), refusal ?? byId("controls").dataset.answer ?? "");
}

function render(status) {
  latest = status;
  verdict(status.go, status.reasons);
  list(byId("cautions"), status.cautions);
  controls(status);
  pictures = status.pictures;
  if (status.health === null) return;
  summary(status);
  cameras(status);
  parts(status);
}

async function ask(url, options = {}) {
  return fetch(url, { cache: "no-store", credentials: "same-origin", signal: AbortSignal.timeout(SILENT_MS), ...options });
}

async function poll() {
  try {
    const answer = await ask("/api/status");
    if (!answer.ok) throw new Error(`the monitor answers ${answer.status}`);
    render(await answer.json());
    heardMs = performance.now();
  } catch { /* told by watch(), which sees that nothing was heard */ }
  setTimeout(poll, PERIOD_MS);
}

function watch() {
  const silentMs = performance.now() - heardMs;
  if (silentMs > SILENT_MS) {
    const seconds = Math.round(silentMs / 1000);
    verdict(false, [{ name: "monitor", message: `not heard for ${seconds} s: look to the network, then to the flight computer` }]);
    byId("start").disabled = byId("stop").disabled = true;
  }
  setTimeout(watch, 250);
}

async function look() {
  await Promise.allSettled(Object.keys(pictures).map(async (place) => {
    const image = card(place).querySelector("img");
    const index = String(pictures[place].trigger_index);
    if (image.dataset.index === index) return;
    const answer = await ask(`/api/thumbnail/${place}`);
    if (!answer.ok) return;
    const url = URL.createObjectURL(await answer.blob());
    const before = image.src;
    image.src = url;
    image.dataset.index = index;
    if (before) URL.revokeObjectURL(before);
  }));
  setTimeout(look, PICTURE_PERIOD_MS);
}

function confirmed(action) {
  const dialog = byId("confirm");
  show(byId("question"), action === "stop" ? `Stop recording ${latest.health.flight}?` : "Start recording?");
  return new Promise((resolve) => {
    byId("yes").onclick = () => dialog.close("yes");
    byId("no").onclick = () => dialog.close("no");
    dialog.onclose = () => resolve(dialog.returnValue === "yes");
    dialog.returnValue = "no";
    dialog.showModal();
  });
}

async function act(action) {
  const flight = latest.health.flight;
  if (!await confirmed(action)) return;
  let said;
  try {
    const answer = await ask("/api/control", {
      method: "POST",
      headers: { "content-type": "application/json", "x-wingshape": "monitor" },
      body: JSON.stringify({ action, flight }),
      signal: AbortSignal.timeout(15000),
    });
    said = (await answer.json()).message;
  } catch (error) {
    said = `no answer: ${error.message}`;
  }
  byId("controls").dataset.answer = said;
  show(byId("control-note"), said);
}

byId("start").addEventListener("click", () => act("start"));
byId("stop").addEventListener("click", () => act("stop"));
poll();
watch();
look();
