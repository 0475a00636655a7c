"use strict";
(async () => {
const data = JSON.parse(document.getElementById("data").textContent);
const [width, height] = data.size;
const find = (id) => document.getElementById(id);
const stage = find("stage"), canvas = find("picture");
const VIEWS = ["light", "normals", "diffuse", "specular", "exponent", "ambient", "height"];
const NAMES = ["Under the lamp", "Normals", "Diffuse", "Specular", "Exponent", "Ambient", "Height"];
const TEXTURES = ["diffuse", "specular", "ambient", "shininess", "normals", "relief"];

const VERTEX = `#version 300 es
void main() {
  vec2 corner = vec2(gl_VertexID & 1, gl_VertexID >> 1) * 4.0 - 1.0;
  gl_Position = vec4(corner, 0, 1);
}`;

// Everything in the camera's axes: x right, y up, z to the camera. Texels count from
// the upper left, so y turns round between the two.
const FRAGMENT = `#version 300 es
precision highp float;
precision highp int;
precision highp sampler2D;
uniform sampler2D diffuse, specular, ambient, shininess, normals, relief;
uniform vec3 lamp, ambientLight;
uniform vec2 diffuseRange, specularRange, ambientRange, shininessRange, reliefRange;
uniform vec2 corner;
uniform float step_, strength;
uniform int view, samples;
uniform bool parallel, mirrored, gate, normalized, shadows;
out vec4 shown;

vec3 decode(vec3 c) {
  return mix(c / 12.92, pow((c + 0.055) / 1.055, vec3(2.4)), greaterThan(c, vec3(0.04045)));
}
vec3 encode(vec3 c) {
  c = clamp(c, 0.0, 1.0);
  return mix(12.92 * c, 1.055 * pow(c, vec3(1.0 / 2.4)) - 0.055, greaterThan(c, vec3(0.0031308)));
}
bool there(ivec2 at) {
  ivec2 size = textureSize(relief, 0);
  return all(greaterThanEqual(at, ivec2(0))) && all(lessThan(at, size))
    && texelFetch(relief, at, 0).b > 0.25;
}
float value(ivec2 at) {
  vec3 bytes = texelFetch(relief, at, 0).rgb * 255.0;
  return mix(reliefRange.x, reliefRange.y, (bytes.r * 256.0 + bytes.g) / 65535.0);
}
vec3 normalAt(ivec2 at) {
  ivec3 bytes = ivec3(texelFetch(normals, at, 0).rgb * 255.0 + 0.5);
  vec2 flat_ = vec2((bytes.r << 4) | (bytes.b >> 4), (bytes.g << 4) | (bytes.b & 15)) / 4095.0 * 2.0 - 1.0;
  vec3 n = vec3(flat_, 1.0 - abs(flat_.x) - abs(flat_.y));
  if (n.z < 0.0) n.xy = (1.0 - abs(n.yx)) * vec2(n.x < 0.0 ? -1.0 : 1.0, n.y < 0.0 ? -1.0 : 1.0);
  return normalize(n);
}
// Where a ray to the lamp goes, per texel of its longer way along the picture: texels,
// and the value that surfaces must not exceed. Straight in both, pinhole or not.
bool path(vec2 start, float v, out vec2 along, out float climb, out float skip) {
  vec2 way;
  float gain;
  if (parallel) {
    way = vec2(lamp.x, -lamp.y);
    gain = lamp.z;
  } else {
    vec2 plane = corner + vec2(start.x, -start.y) * step_;
    float depth = 1.0 / v, far = 0.5 * depth / max(abs(lamp.z), 0.5);
    float end = depth - far * lamp.z;
    vec2 moved = (plane * depth + far * lamp.xy) / end - plane;
    way = vec2(moved.x, -moved.y) / step_;
    gain = 1.0 / end - v;
  }
  float longer = max(abs(way.x), abs(way.y));
  if (longer < 1e-6) return false;
  along = way / longer;
  climb = gain / longer;
  skip = parallel ? 0.5 * longer : 0.5;
  return true;
}
// Edges of the surface's triangles: columns, rows and diagonals of texels.
const vec2 EDGES[3] = vec2[3](vec2(1, 0), vec2(0, 1), vec2(1, -1));
bool blockedBy(int edges, vec2 start, float v, vec2 along, float climb, float skip) {
  ivec2 size = textureSize(relief, 0);
  float first = dot(start, EDGES[edges]), rate = dot(along, EDGES[edges]);
  if (abs(rate) < 1e-4) return false;
  float spacing = 1.0 / abs(rate);
  float reach = rate > 0.0 ? floor(first) + 1.0 - first : first - ceil(first) + 1.0;
  if (reach < 1e-4) reach += 1.0;
  reach *= spacing;
  while (reach < skip) reach += spacing;
  int most = 2 * max(size.x, size.y) + 2;
  for (int k = 0; k < most; k++) {
    float far = reach + float(k) * spacing;
    vec2 at = start + far * along;
    float ray = v + far * climb;
    if (ray > reliefRange.y) return false;
    if (any(lessThan(at, vec2(-0.01))) || any(greaterThan(at, vec2(size) - 0.99))) return false;
    // Between the two texels that end the edge.
    ivec2 a = ivec2(floor(at)), nearest = ivec2(floor(at + 0.5));
    float share = at.x - floor(at.x);
    ivec2 b;
    if (edges == 0) { a.x = nearest.x; share = at.y - floor(at.y); b = a + ivec2(0, 1); }
    else if (edges == 1) { a.y = nearest.y; b = a + ivec2(1, 0); }
    else { a.y = a.x - int(floor(at.x - at.y + 0.5)); b = a + ivec2(1, 1); }
    if (share < 1e-4) b = a;
    if (there(a) && there(b) && mix(value(a), value(b), share) > ray) return true;
  }
  return false;
}
bool blocked(vec2 start, float v) {
  vec2 along;
  float climb, skip;
  if (!path(start, v, along, climb, skip)) return false;
  for (int edges = 0; edges < 3; edges++)
    if (blockedBy(edges, start, v, along, climb, skip)) return true;
  return false;
}
float unshadowed(ivec2 at) {
  float here = value(at);
  if (samples == 1) return blocked(vec2(at), here) ? 0.0 : 1.0;
  float lit = 0.0;
  for (int k = 0; k < 4; k++) {
    ivec2 to = ivec2((k & 1) * 2 - 1, (k >> 1) * 2 - 1);
    vec2 start = vec2(at);
    float v = here;
    if (to.x == to.y) {
      if (there(at + to)) { start += 0.25 * vec2(to); v += 0.25 * (value(at + to) - here); }
    } else {
      ivec2 x = at + ivec2(to.x, 0), y = at + ivec2(0, to.y);
      if (there(x)) { start.x += 0.25 * float(to.x); v += 0.25 * (value(x) - here); }
      if (there(y)) { start.y += 0.25 * float(to.y); v += 0.25 * (value(y) - here); }
    }
    lit += blocked(start, v) ? 0.0 : 0.25;
  }
  return lit;
}
// Viridis, by a polynomial.
vec3 scale(float t) {
  const vec3 a = vec3(0.2777, 0.0054, 0.3341), b = vec3(0.1051, 1.4046, 1.3846), c = vec3(-0.3309, 0.2148, 0.0951),
    d = vec3(-4.6342, -5.7991, -19.3324), e = vec3(6.2283, 14.1799, 56.6906), f = vec3(4.7764, -13.7451, -65.3530), g = vec3(-5.4355, 4.6459, 26.3124);
  return a + t * (b + t * (c + t * (d + t * (e + t * (f + t * g)))));
}
void main() {
  ivec2 at = ivec2(gl_FragCoord.xy);
  at.y = textureSize(relief, 0).y - 1 - at.y;
  if (texelFetch(relief, at, 0).b < 0.75) { shown = vec4(0, 0, 0, 1); return; }
  vec3 n = normalAt(at);
  vec3 kd = diffuseRange.y * decode(texelFetch(diffuse, at, 0).rgb);
  vec3 ks = specularRange.y * decode(texelFetch(specular, at, 0).rgb);
  vec3 ka = ambientRange.y * decode(texelFetch(ambient, at, 0).rgb);
  vec3 level = texelFetch(shininess, at, 0).rgb;
  vec3 f = exp(mix(vec3(shininessRange.x), vec3(shininessRange.y), level));
  vec3 colour;
  if (view == 1) colour = n * 0.5 + 0.5;
  else if (view == 2) colour = encode(kd);
  else if (view == 3) colour = encode(ks);
  else if (view == 4) colour = scale((level.r + level.g + level.b) / 3.0);
  else if (view == 5) colour = encode(ka);
  else if (view == 6) colour = scale((value(at) - reliefRange.x) / (reliefRange.y - reliefRange.x));
  else {
    vec2 plane = corner + vec2(at.x, -at.y) * step_;
    vec3 v = parallel ? vec3(0, 0, 1) : normalize(vec3(-plane, 1.0));
    float facing = dot(n, lamp);
    vec3 between = lamp + v;
    float cosine = mirrored ? dot(2.0 * facing * n - lamp, v)
      : dot(between, between) > 0.0 ? dot(normalize(between), n) : 0.0;
    if (gate && facing <= 0.0) cosine = 0.0;
    vec3 lobe = cosine > 0.0 ? exp(f * log(cosine)) : vec3(0);
    if (normalized) { lobe *= (f + 2.0) / 6.283185307; kd /= 3.14159265; }
    float lit = shadows && (facing > 0.0 || !gate) ? unshadowed(at) : 1.0;
    colour = encode(ka * ambientLight + strength * lit * (kd * max(facing, 0.0) + ks * lobe));
  }
  shown = vec4(clamp(colour, 0.0, 1.0), 1);
}`;

function fail(words) {
  find("problem").textContent = words;
  find("problem").hidden = false;
  find("hint").hidden = true;
}

const gl = canvas.getContext("webgl2", { alpha: false, antialias: false });
if (!gl) return fail("This page needs WebGL 2, which this browser does not offer or has switched off.");
if (Math.max(width, height) > gl.getParameter(gl.MAX_TEXTURE_SIZE))
  return fail(`The maps have ${width} × ${height} pixels, more than this graphics card takes.`);
canvas.width = width;
canvas.height = height;

const program = gl.createProgram();
for (const [kind, text] of [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, FRAGMENT]]) {
  const shader = gl.createShader(kind);
  gl.shaderSource(shader, text);
  gl.compileShader(shader);
  gl.attachShader(program, shader);
  if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) return fail(gl.getShaderInfoLog(shader));
}
gl.linkProgram(program);
gl.useProgram(program);
const at = (name) => gl.getUniformLocation(program, name);

async function load(name, unit) {
  const response = await (await fetch(data.textures[name])).blob();
  // Numbers, not colours: nothing may convert them.
  const picture = await createImageBitmap(response, { premultiplyAlpha: "none", colorSpaceConversion: "none" });
  gl.activeTexture(gl.TEXTURE0 + unit);
  gl.bindTexture(gl.TEXTURE_2D, gl.createTexture());
  gl.pixelStorei(gl.UNPACK_COLORSPACE_CONVERSION_WEBGL, gl.NONE);
  gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGB8, gl.RGB, gl.UNSIGNED_BYTE, picture);
  for (const key of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, key, gl.NEAREST);
  gl.uniform1i(at(name), unit);
}
for (const [unit, name] of TEXTURES.entries()) {
  await load(name, unit);
  delete data.textures[name];
}
for (const [name, range] of Object.entries(data.ranges)) gl.uniform2fv(at(name + "Range"), range);
gl.uniform3fv(at("ambientLight"), data.ambient);
gl.uniform2fv(at("corner"), data.corner);
gl.uniform1f(at("step_"), data.step);
gl.uniform1i(at("parallel"), data.parallel);
gl.uniform1i(at("mirrored"), data.model.mirror);
gl.uniform1i(at("gate"), data.model.gate);
gl.uniform1i(at("normalized"), data.model.normalized);

// Where the lamp is: its direction's x and y, up to the horizon.
const START = [0.4, 0.45];
const state = { lamp: [...START], view: 0, shadows: true, zoom: 1, left: 0, top: 0, held: false };
const direction = ([x, y]) => [x, y, Math.sqrt(Math.max(1 - x * x - y * y, 0))];

function draw(samples) {
  gl.viewport(0, 0, width, height);
  gl.uniform3fv(at("lamp"), direction(state.lamp));
  gl.uniform1f(at("strength"), 2 ** Number(find("strength").value));
  gl.uniform1i(at("view"), state.view);
  gl.uniform1i(at("shadows"), state.shadows);
  gl.uniform1i(at("samples"), samples);
  gl.drawArrays(gl.TRIANGLES, 0, 3);
}

let waiting = false, quiet = 0;
function show() {
  const [x, y, z] = direction(state.lamp);
  find("lamp").setAttribute("cx", x);
  find("lamp").setAttribute("cy", -y);
  const height = (Math.asin(z) * 180 / Math.PI).toFixed(0), turn = ((Math.atan2(y, x) * 180 / Math.PI + 360) % 360).toFixed(0);
  find("where").textContent = `${height}° up, ${turn}° round`;
  find("stops").textContent = `× ${(2 ** Number(find("strength").value)).toFixed(2)}`;
  find("view").value = VIEWS[state.view];
  find("shadows").checked = state.shadows;
  const ends = { exponent: data.ranges.shininess.map(Math.exp), height: data.heights }[VIEWS[state.view]];
  find("legend").hidden = !ends;
  if (ends) [find("least").textContent, find("most").textContent] = ends.map((end) => Number(end.toPrecision(3)));
  if (waiting) return;
  waiting = true;
  requestAnimationFrame(() => {
    waiting = false;
    // Soft edges take four times as long: they come when the lamp rests.
    draw(1);
    clearTimeout(quiet);
    quiet = setTimeout(() => draw(4), 120);
  });
}

function place() {
  const box = stage.getBoundingClientRect();
  const fit = Math.min(box.width / width, box.height / height);
  const size = fit * state.zoom;
  const spare = [Math.max(box.width - size * width, 0), Math.max(box.height - size * height, 0)];
  // Some of it stays in view.
  state.left = Math.min(Math.max(state.left, Math.min(box.width - size * width, 0)), 0);
  state.top = Math.min(Math.max(state.top, Math.min(box.height - size * height, 0)), 0);
  canvas.style.transform = `translate(${state.left + spare[0] / 2}px, ${state.top + spare[1] / 2}px) scale(${size})`;
  canvas.style.imageRendering = size > 3 ? "pixelated" : "auto";
}

function zoom(factor, x, y) {
  const box = stage.getBoundingClientRect();
  x = (x ?? box.left + box.width / 2) - box.left;
  y = (y ?? box.top + box.height / 2) - box.top;
  const before = state.zoom;
  state.zoom = Math.min(Math.max(before * factor, 1), 64);
  const ratio = state.zoom / before;
  state.left = x - (x - state.left) * ratio;
  state.top = y - (y - state.top) * ratio;
  place();
}

function aim(x, y) {
  const length = Math.hypot(x, y);
  const most = Math.max(length / 0.999, 1);
  state.lamp = [x / most, y / most];
  find("hint").classList.add("gone");
  show();
}
function aimAt(event) {
  const box = stage.getBoundingClientRect();
  const radius = Math.min(box.width, box.height) / 2;
  aim((event.clientX - box.left - box.width / 2) / radius, (box.top + box.height / 2 - event.clientY) / radius);
}

const touching = new Map();
const spread = () => {
  const [a, b] = [...touching.values()];
  return { x: (a.clientX + b.clientX) / 2, y: (a.clientY + b.clientY) / 2, far: Math.hypot(a.clientX - b.clientX, a.clientY - b.clientY) };
};
stage.addEventListener("pointerdown", (event) => {
  stage.setPointerCapture(event.pointerId);
  touching.set(event.pointerId, event);
  if (touching.size === 1 && !event.shiftKey && event.button === 0 && find("follow").checked) aimAt(event);
});
stage.addEventListener("pointermove", (event) => {
  const last = touching.get(event.pointerId);
  if (touching.size === 2 && last) {
    const before = spread();
    touching.set(event.pointerId, event);
    const now = spread();
    state.left += now.x - before.x;
    state.top += now.y - before.y;
    zoom(now.far / Math.max(before.far, 1), now.x, now.y);
    return;
  }
  if (last) touching.set(event.pointerId, event);
  const pans = last && (event.shiftKey || last.button === 1 || event.buttons & 6 || !find("follow").checked);
  if (pans) {
    state.left += event.clientX - last.clientX;
    state.top += event.clientY - last.clientY;
    place();
  } else if (find("follow").checked && (last || event.pointerType === "mouse")) aimAt(event);
});
for (const name of ["pointerup", "pointercancel"]) stage.addEventListener(name, (event) => touching.delete(event.pointerId));
stage.addEventListener("wheel", (event) => {
  event.preventDefault();
  zoom(2 ** (-event.deltaY / 300), event.clientX, event.clientY);
}, { passive: false });

const dial = find("dial");
const turnDial = (event) => {
  if (!event.buttons) return;
  const box = dial.getBoundingClientRect();
  aim((event.clientX - box.left - box.width / 2) / box.width * 2.2, (box.top + box.height / 2 - event.clientY) / box.height * 2.2);
};
dial.addEventListener("pointerdown", (event) => { dial.setPointerCapture(event.pointerId); turnDial(event); });
dial.addEventListener("pointermove", turnDial);

function reset() {
  Object.assign(state, { lamp: [...START], view: 0, shadows: true, zoom: 1, left: 0, top: 0 });
  find("strength").value = 0;
  place();
  show();
}
const KEYS = {
  ArrowLeft: () => aim(state.lamp[0] - 0.05, state.lamp[1]),
  ArrowRight: () => aim(state.lamp[0] + 0.05, state.lamp[1]),
  ArrowUp: () => aim(state.lamp[0], state.lamp[1] + 0.05),
  ArrowDown: () => aim(state.lamp[0], state.lamp[1] - 0.05),
  s: () => { state.shadows = !state.shadows; show(); },
  v: () => { state.view = (state.view + 1) % VIEWS.length; show(); },
  "+": () => zoom(1.25), "=": () => zoom(1.25), "-": () => zoom(0.8), 0: reset,
};
document.addEventListener("keydown", (event) => {
  if (event.ctrlKey || event.metaKey || event.altKey) return;
  const arrow = event.key.startsWith("Arrow");
  // Sliders and lists have arrows of their own.
  if (/^(INPUT|SELECT)$/.test(event.target.tagName) && (arrow || event.target.tagName === "SELECT")) return;
  const act = KEYS[event.key] ?? KEYS[event.key.toLowerCase()];
  if (!act) return;
  event.preventDefault();
  act();
});
for (const [k, name] of VIEWS.entries()) find("view").add(new Option(NAMES[k], name));
find("view").addEventListener("change", (event) => { state.view = VIEWS.indexOf(event.target.value); show(); });
find("shadows").addEventListener("change", (event) => { state.shadows = event.target.checked; show(); });
find("strength").addEventListener("input", show);
find("closer").addEventListener("click", () => zoom(1.25));
find("further").addEventListener("click", () => zoom(0.8));
find("reset").addEventListener("click", reset);
new ResizeObserver(place).observe(stage);
canvas.addEventListener("webglcontextlost", () => fail("The graphics card has dropped this page; load it again."));
if (!matchMedia("(hover: hover)").matches) find("hint").textContent = "Touch to move the lamp";
place();
show();

// For programs that look at the page: the picture under a lamp, row by row from the top.
globalThis.phongfit = {
  relight(lamp, shadows = true) {
    const kept = { ...state };
    const length = Math.hypot(...lamp);
    Object.assign(state, { lamp: [lamp[0] / length, lamp[1] / length], view: 0, shadows });
    draw(4);
    const bytes = new Uint8Array(4 * width * height);
    gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, bytes);
    Object.assign(state, kept);
    show();
    const rows = [];
    for (let y = height - 1; y >= 0; y--) rows.push([...bytes.subarray(4 * width * y, 4 * width * (y + 1))]);
    return rows;
  },
};
})();
