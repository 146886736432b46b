"use strict";
// What the pages share: their data, WebGL2 in a canvas, the state in the address, and the controls below. Everything a
// page knows is in the element viewer-data.
const data = JSON.parse(document.getElementById("viewer-data").textContent);
const find = (id) => document.getElementById(id);
const canvas = find("canvas");
const gl = canvas.getContext("webgl2", { antialias: false, preserveDrawingBuffer: true, alpha: false });
const able = gl && typeof DecompressionStream !== "undefined"; // else the still picture stays

// -- vectors --------------------------------------------------------------------------------------------------------

const add = (a, b, s = 1) => a.map((x, i) => x + s * b[i]);
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const scaled = (a, s) => a.map((x) => x * s);
const unit = (a) => scaled(a, 1 / Math.hypot(...a));

function rotated(v, axis, degrees) {
  // Rodrigues
  const [c, s] = [Math.cos((degrees * Math.PI) / 180), Math.sin((degrees * Math.PI) / 180)];
  return add(add(scaled(v, c), cross(axis, v), s), axis, dot(axis, v) * (1 - c));
}

const copy = (value) => JSON.parse(JSON.stringify(value));
const same = (a, b) => JSON.stringify(a) === JSON.stringify(b);

// -- WebGL ----------------------------------------------------------------------------------------------------------

function compiled(defined, vertex, fragment, attributes = []) {
  const head = ["#version 300 es", ...defined.map((one) => `#define ${one}`)];
  head.push("precision highp float;", "precision highp int;", "precision highp sampler2D;", "");
  const made = gl.createProgram();
  for (const [kind, text] of [
    [gl.VERTEX_SHADER, vertex],
    [gl.FRAGMENT_SHADER, fragment],
  ]) {
    const part = gl.createShader(kind);
    gl.shaderSource(part, head.join("\n") + text);
    gl.compileShader(part);
    gl.attachShader(made, part);
    if (!gl.getShaderParameter(part, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(part));
  }
  attributes.forEach((key, i) => gl.bindAttribLocation(made, i, key));
  gl.linkProgram(made);
  if (!gl.getProgramParameter(made, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(made));
  const places = {};
  return { made, place: (key) => (places[key] ??= gl.getUniformLocation(made, key)) };
}

function uniforms(place, numbers, truths, triples) {
  for (const [key, value] of Object.entries(numbers)) gl.uniform1f(place(key), value ?? 0);
  for (const [key, value] of Object.entries(truths)) gl.uniform1i(place(key), Number(value ?? 0));
  for (const [key, value] of Object.entries(triples)) if (value.length) gl.uniform3fv(place(key), value);
}

async function unpacked(text) {
  const bytes = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
  return new Response(new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"))).arrayBuffer();
}

function texture(at, width, height, [internal, format, type], values) {
  gl.activeTexture(gl.TEXTURE0 + at);
  gl.bindTexture(gl.TEXTURE_2D, gl.createTexture());
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.NEAREST);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.NEAREST);
  gl.texImage2D(gl.TEXTURE_2D, 0, internal, width, height, 0, format, type, values);
}

// -- controls -------------------------------------------------------------------------------------------------------

function pixelOf(event) {
  const box = canvas.getBoundingClientRect();
  const [x, y] = [(event.clientX - box.left) / box.width, (event.clientY - box.top) / box.height];
  if (x < 0 || y < 0 || x >= 1 || y >= 1) return null;
  return [Math.floor(x * canvas.width), Math.floor(y * canvas.height)];
}

const arrow = (event) => ({ ArrowLeft: [-3, 0], ArrowRight: [3, 0], ArrowUp: [0, -3], ArrowDown: [0, 3] })[event.key];

const digits = (values) =>
  values
    .slice(0, data.channels.length)
    .map((x) => (x === 0 ? "0" : Math.abs(x) < 1e-3 || Math.abs(x) >= 1e4 ? x.toExponential(2) : x.toPrecision(4)))
    .join("  ");

function options(select, names) {
  select.replaceChildren(...names.map(([value, text]) => new Option(text, value)));
}

function items(list, texts) {
  const made = texts.map(() => document.createElement("li"));
  texts.forEach((text, i) => (made[i].textContent = text));
  list.replaceChildren(...made);
}

// -- the state ------------------------------------------------------------------------------------------------------

function to_address(told, first) {
  const said = new URLSearchParams();
  for (const [key, value] of Object.entries(told)) {
    const parts = [value].flat().map((x) => (typeof x === "number" ? +x.toPrecision(9) : x));
    if (!same(value, first[key])) said.set(key, parts.join(","));
  }
  if (location.protocol !== "about:") history.replaceState(null, "", `#${said.toString().replaceAll("%2C", ",")}`);
}

function from_address(first, words) {
  const read = {};
  for (const [key, text] of new URLSearchParams(location.hash.slice(1))) {
    const numbers = text.split(",").map(Number);
    const known = [first[key]].flat();
    const fits = typeof known[0] === "number" && numbers.every(Number.isFinite) && numbers.length === known.length;
    if (typeof first[key] === "boolean") read[key] = text === "true";
    else if (words[key]?.includes(text)) read[key] = text;
    else if (fits && (Math.hypot(...numbers) || !key.startsWith("light")))
      read[key] = Array.isArray(first[key]) ? numbers : numbers[0];
  }
  return read;
}

// Paints the state anew after each change, and keeps in the address what of it differs from the first: `told` says it
// as the address does, `take` takes what an address says. What is returned asks for a new painting.
function begin(state, { load, paint, told, take, words }) {
  const first = [copy(state), copy(told())];
  let waiting = 0;
  function show() {
    waiting = 0;
    paint();
    find("exposure").value = state.exposure;
    find("stops").textContent = `${state.exposure > 0 ? "+" : ""}${(+state.exposure).toFixed(2)} stops`;
    [find("srgb").checked, find("marked").checked] = [state.srgb, state.marked];
    to_address(told(), first[1]);
  }
  const update = () => {
    waiting ||= requestAnimationFrame(show);
  };
  async function start() {
    await load();
    take(from_address(first[1], words));
    items(find("notes"), data.notes);
    find("exposure").addEventListener("input", (event) => {
      state.exposure = Number(event.target.value);
      update();
    });
    for (const key of ["srgb", "marked"])
      find(key).addEventListener("change", (event) => {
        state[key] = event.target.checked;
        update();
      });
    addEventListener("hashchange", () => {
      Object.assign(state, copy(first[0]));
      take(from_address(first[1], words));
      update();
    });
    find("viewer").classList.add("drawn");
    find("fixed").hidden = data.drawable;
    show();
  }
  start().catch((error) => {
    // whatever fails here, the still picture stays
    find("viewer").classList.remove("drawn");
    find("fixed").hidden = false;
    console.error(error);
  });
  return update;
}
