// The page: sliders ask for a picture, buttons for targets and fits.

import { Panel, make, symbol } from "./controls.js";

const $ = (selector) => document.querySelector(selector);

let about, settings, options;
let target = null;
let seed = 0;
let found = null;
// Positions of the sliders that were set to the fit, before that.
let before = null;

// Asking the server. What is wrong comes as an Error with one line.

async function ask(path, body, type = "application/json", signal = null) {
  let response;
  try {
    response = await fetch(path, body === undefined ? {} : {
      method: "POST", body, headers: { "content-type": type }, signal,
    });
  } catch (error) {
    if (signal?.aborted) throw error;
    throw new Error("The server does not answer. Is it still running?");
  }
  if (response.ok) return response;
  const text = await response.text();
  let words = `the server answered ${response.status}: ${text.slice(0, 200)}`;
  try { words = JSON.parse(text).error ?? words; } catch { /* It was no JSON. */ }
  throw new Error(words);
}

const post = async (path, record, signal) =>
  ask(path, JSON.stringify(record), "application/json", signal);
const json = async (response) => (await response).json();

async function upload(path, file, more = {}) {
  if (file.size > about.max_bytes) {
    throw new Error(`${file.name}: ${file.size} bytes came, at most ${about.max_bytes} are wanted`);
  }
  const query = new URLSearchParams({ name: file.name, ...more });
  return json(ask(`${path}?${query}`, file, "application/octet-stream"));
}

// Messages.

function report(message) {
  $("#problem span").textContent = message;
  $("#problem").hidden = message === "";
}

/** What a press of a button or a chosen file does; a failure is reported, no more. */
function handler(work) {
  return async (event) => {
    report("");
    try { await work(event); } catch (error) { report(error.message); }
  };
}

function onFile(id, work) {
  $(id).addEventListener("change", handler(async ({ target: input }) => {
    const [file] = input.files;
    // The same file may be chosen again, once it is mended.
    try { if (file) await work(file); } finally { input.value = ""; }
  }));
}

// The picture. One request at a time: sliders move faster than any server answers.

let moved = null;
let drawing = false;

async function draw() {
  moved = performance.now();
  if (drawing) return;
  drawing = true;
  $("#picture").ariaBusy = "true";
  try {
    while (moved !== null) {
      const since = moved;
      moved = null;
      await drawOnce();
      $("#answered").textContent = `· ${Math.round(performance.now() - since)} ms`;
    }
    if (!$("#problem").hidden && $("#problem").dataset.of === "picture") report("");
  } catch (error) {
    moved = null;
    report(error.message);
    $("#problem").dataset.of = "picture";
  } finally {
    drawing = false;
    $("#picture").ariaBusy = "false";
  }
}

async function drawOnce() {
  const of = target?.photograph ? target.target : null;
  const response = await post("/api/picture", { settings: settings.values, target: of });
  await show($("#picture"), URL.createObjectURL(await response.blob()));
  if (of !== null) await drawOutline(of);
}

/** Where the surface ends, over the photograph on which it is laid. */
async function drawOutline(of) {
  const answer = await json(post("/api/outline", { settings: settings.values, target: of }));
  if (target?.target === of) $("#outline path").setAttribute("d", answer.path);
}

async function show(figure, address) {
  const image = figure.querySelector("img");
  const before = image.src;
  image.src = address;
  await image.decode();
  figure.hidden = false;
  if (before.startsWith("blob:")) URL.revokeObjectURL(before);
}

// Targets.

async function setTarget(made, words) {
  forgetFit();
  target = made;
  const photograph = made?.photograph ?? false;
  $("#target-figure").hidden = made === null;
  $("#frame").hidden = !photograph;
  $("#drop").hidden = made === null;
  $("#fit").disabled = made === null;
  $("#state").textContent = made === null ? "Make or load a target first." : "";
  const notes = (made?.notes ?? []).map((line) => make("li", {}, sentence(line)));
  $("#notes").replaceChildren(...notes);
  const brighter = brighterOf(made ?? { brighten: 1 });
  for (const span of document.querySelectorAll(".brightened")) {
    span.textContent = brighter && `${brighter}, like the target`;
  }
  if (made !== null) {
    $("#target-figure figcaption span").textContent = words;
    $("#outline").setAttribute("viewBox", `0 0 ${made.width} ${made.height}`);
    $("#outline path").setAttribute("d", "");
    await show($("#target-figure"), made.picture);
  }
  await draw();
}

function sentence(line) {
  return `${line[0].toUpperCase()}${line.slice(1)}.`;
}

function wordsOf(photograph) {
  const words = [`${photograph.width} × ${photograph.height}`];
  if (photograph.shrunk > 1) words.push(`shrunk ${photograph.shrunk} times`);
  if (brighterOf(photograph)) words.push(brighterOf(photograph));
  return words.join(", ");
}

// What stands beside the target is shown as much brighter as the target is, to be compared.
function brighterOf({ brighten }) {
  return brighten > 1 ? `shown ${brighten.toFixed(1)} × brighter` : "";
}

async function makeTarget() {
  const noise = $("#noise").valueAsNumber;
  if (!(noise >= about.noise.minimum && noise <= about.noise.maximum)) {
    throw new Error(`noise: a number from ${about.noise.minimum} to ${about.noise.maximum} is wanted`);
  }
  seed += 1;
  const made = await json(post("/api/target", { settings: settings.values, noise, seed }));
  await setTarget(made, `made, noise ${noise}`);
}

async function loadPhotograph(file) {
  const encoding = $("#encoding").value;
  const loaded = await upload("/api/photograph", file, { encoding });
  await setTarget(loaded, wordsOf(loaded));
}

/** One of the photographs that the command was given, with its lamp and its ball. */
async function choosePhotograph(number) {
  const chosen = await json(post("/api/chosen", { number }));
  mesh = null;
  settings.set(chosen.settings);
  options.set(chosen.options);
  nameSurface();
  await setTarget(chosen, `${about.photographs[number]}, ${wordsOf(chosen)}`);
}

async function loadMask(file) {
  const { notes } = target;
  const masked = { ...await upload("/api/mask", file, { target: target.target }), notes };
  const { centre_x, centre_y, radius } = masked;
  settings.set({ centre_x, centre_y, radius });
  await setTarget(masked, `${wordsOf(masked)}, masked`);
}

// Surfaces.

let mesh = null;

async function setSurface(surface, name) {
  mesh = name;
  settings.set({ surface });
  nameSurface();
  await draw();
}

function nameSurface() {
  const smooth = settings.values.shading === "phong";
  $("#surface-name").textContent = mesh ?? (smooth ? "Sphere" : "Sphere, cut into triangles");
  $("#sphere").hidden = mesh === null;
  $("[data-group=view]").hidden = mesh === null;
}

async function loadMesh(file) {
  const loaded = await upload("/api/mesh", file);
  await setSurface(loaded.surface, `${file.name}, ${loaded.faces.toLocaleString("en")} faces`);
}

// Fits.

let running = null;

/** Whoever waits for a fit waits no more; what the server finds is not looked at. */
function cancelFit() {
  running?.abort();
  running = null;
  $("#cancel").hidden = true;
  $("#fit").disabled = target === null;
}

function forgetFit() {
  cancelFit();
  found = null;
  keepBefore(null);
  for (const id of ["#result", "#fitted-figure", "#residual-figure"]) $(id).hidden = true;
}

/** `positions`: what “Back” will set the sliders to; null if there is nothing to undo. */
function keepBefore(positions) {
  before = positions;
  $("#back").hidden = positions === null;
}

async function moveTo(positions) {
  settings.set(positions);
  $("#preset").value = "";
  await draw();
}

async function fit() {
  const { signal } = running = new AbortController();
  $("#fit").disabled = true;
  $("#cancel").hidden = false;
  const start = performance.now();
  const waiting = () => {
    const seconds = Math.floor((performance.now() - start) / 1000);
    $("#state").textContent = `Fitting … ${seconds} s (the first of its kind is compiled)`;
  };
  const clock = setInterval(waiting, 1000);
  waiting();
  try {
    const request = { settings: settings.values, target: target.target, options: options.values };
    const answer = await json(post("/api/fit", request, signal));
    if (signal.aborted) return;
    found = answer;
    keepBefore(null);
    await showFit();
    $("#state").textContent = `Fitted in ${found.seconds.toFixed(2)} s.`;
    cancelFit();
  } catch (error) {
    if (signal.aborted) return;
    $("#state").textContent = "";
    cancelFit();
    throw error;
  } finally {
    clearInterval(clock);
  }
}

async function showFit() {
  $("#head").textContent = `${found.head}.`;
  const differs = found.differs.length === 0 ? []
    : [`the target was made otherwise: ${found.differs.join(", ")}`];
  const lines = [...differs, ...found.warnings].map((line) => make("li", {}, line));
  $("#warnings").replaceChildren(...lines);
  $("#result tbody").replaceChildren(...found.rows.map(rowOf));
  $("#result table").classList.toggle("untrue", found.rows.every((row) => !row.truth));
  $("#result pre").textContent = found.text;
  const [lowest, , highest] = $("#residual-figure .ends").children;
  lowest.textContent = `−${found.scale.toPrecision(2)}`;
  highest.textContent = `+${found.scale.toPrecision(2)}`;
  await show($("#fitted-figure"), found.fitted);
  await show($("#residual-figure"), found.residual);
  $("#result").hidden = false;
  // On a phone they stand below the button.
  $("#view").scrollIntoView({ block: "nearest" });
}

function rowOf(row) {
  const [first, ...rest] = row.name.split(" ");
  const start = first === "light" ? first : symbol(first);
  const name = make("th", { scope: "row", title: row.label }, start, ` ${rest.join(" ")}`);
  const texts = [row.truth, row.value, row.error, row.off, row.note];
  const element = make("tr", {}, name, ...texts.map((text) => make("td", {}, text)));
  element.dataset.label = row.label;
  return element;
}

// Start.

async function start() {
  about = await json(ask("/api/settings"));
  settings = new Panel(document, about.settings, (name) => {
    if (about.settings[name].group === "material") $("#preset").value = "";
    nameSurface();
    draw();
  });
  options = new Panel(document, about.options, () => {});
  const { minimum: min, maximum: max, default: value } = about.noise;
  Object.assign($("#noise"), { min, max, value });
  for (const name of Object.keys(about.presets)) {
    $("#preset").append(make("option", { value: name }, name.replaceAll("_", " ")));
  }
  $("#preset").addEventListener("change", ({ target: menu }) => {
    if (menu.value) settings.set(about.presets[menu.value]);
    draw();
  });
  $("#reset").addEventListener("click", () => {
    settings.reset(["surface"]);
    $("#preset").value = "";
    nameSurface();
    draw();
  });
  $("#encoding").addEventListener("change", ({ target: menu }) => {
    $("#photograph").disabled = menu.value === "";
  });
  $("#problem button").addEventListener("click", () => report(""));
  $("#make").addEventListener("click", handler(makeTarget));
  $("#drop").addEventListener("click", handler(() => setTarget(null)));
  $("#sphere").addEventListener("click", handler(() => setSurface("sphere", null)));
  $("#fit").addEventListener("click", handler(fit));
  $("#cancel").addEventListener("click", () => {
    cancelFit();
    $("#state").textContent = "Cancelled.";
  });
  // What has the focus is never behind the pictures that stay at the top.
  new ResizeObserver(([{ target: view }]) => {
    const stays = getComputedStyle(view).position === "sticky";
    document.documentElement.style.scrollPaddingTop = stays ? `${view.offsetHeight}px` : "";
  }).observe($("#view"));
  $("#take").addEventListener("click", handler(async () => {
    const names = Object.keys(found.settings);
    keepBefore(before ?? Object.fromEntries(names.map((name) => [name, settings.values[name]])));
    await moveTo(found.settings);
  }));
  $("#back").addEventListener("click", handler(async () => {
    const positions = before;
    keepBefore(null);
    await moveTo(positions);
  }));
  $("#given").hidden = about.photographs.length === 0;
  about.photographs.forEach((name, number) =>
    $("#photographs").append(make("option", { value: number }, name)));
  $("#photographs").addEventListener("change", handler(async ({ target: menu }) => {
    if (menu.value !== "") await choosePhotograph(Number(menu.value));
  }));
  onFile("#mesh", loadMesh);
  onFile("#photograph", loadPhotograph);
  onFile("#mask", loadMask);
  $("#controls").addEventListener("submit", (event) => event.preventDefault());
  if (about.photographs.length > 0) {
    $("#photographs").value = "0";
    await choosePhotograph(0);
  } else {
    await draw();
  }
}

handler(start)();
