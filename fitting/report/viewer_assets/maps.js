// The page that relights: maps under a distant light that the reader moves, or one of them. Before this stands page.js.
(() => {
  if (!able) return;
  const [left, top, width, height, stride] = data.window;
  const names = data.maps.map(({ name }) => name);
  const first = { map: names[0], light0: data.light, exposure: data.exposure, srgb: true, marked: false };
  const state = copy(first);
  const colours = ["#009e73", "#000000", "#999999", "#0072b2", "#e69f00", "#d55e00"]; // one a reason
  const codes = colours.map((text) => [1, 3, 5].map((at) => parseInt(text.slice(at, at + 2), 16) / 255));
  let surface, k_d, k_s, programs;

  async function load() {
    [surface, k_d, k_s] = await Promise.all(
      [data.surface, data.k_d, data.k_s].map(async (text) => new Uint16Array(await unpacked(text))),
    );
    texture(0, width, height, [gl.RGBA16UI, gl.RGBA_INTEGER, gl.UNSIGNED_SHORT], surface);
    for (const [i, values] of [k_d, k_s].entries())
      texture(1 + i, width, height, [gl.RGBA16F, gl.RGBA, gl.HALF_FLOAT], values);
    [canvas.width, canvas.height] = [width, height];
    programs = data.shader.fragments.map((text) => compiled(data.shader.defined, data.shader.vertex, text));
    options(
      find("map"),
      names.map((name) => [name, name]),
    );
    find("model").textContent = data.models.join(", ");
    find("text").textContent = data.text;
    items(find("reasons"), data.reasons);
    Array.from(find("reasons").children).forEach((item, i) => item.style.setProperty("--swatch", colours[i]));
    find("reasons").children[data.outside].remove();
    find("map").addEventListener("change", (event) => {
      state.map = event.target.value;
      update();
    });
    find("reset").addEventListener("click", () => {
      state.light0 = first.light0;
      update();
    });
  }

  function paint() {
    const { range, legend } = data.maps[names.indexOf(state.map)];
    const coloured = names.indexOf(state.map) < 3;
    const exposure = 2 ** (state.exposure - first.exposure) / range[1];
    gl.viewport(0, 0, width, height);
    gl.clearColor(0, 0, 0, 1);
    gl.clear(gl.COLOR_BUFFER_BIT);
    programs.forEach(({ made, place }, model) => {
      gl.useProgram(made);
      const truths = { surface: 0, diffuse: 1, specular: 2, map: names.indexOf(state.map), model };
      const triples = { to_light: state.light0, to_view: data.to_view, palette: codes.flat() };
      uniforms(place, { exposure }, { ...truths, srgb: state.srgb, marked: state.marked }, triples);
      gl.uniform2f(place("size"), width, height);
      gl.uniform2f(place("range"), ...range);
      gl.drawArrays(gl.TRIANGLES, 0, 3);
    });
    const [x, y] = inPicture(state.light0);
    [find("lamp").style.left, find("lamp").style.top] = [`${100 * x}%`, `${100 * y}%`];
    find("lamp").hidden = state.map !== names[0];
    find("map").value = state.map;
    find("legend").textContent = coloured ? `White is ${(1 / exposure).toPrecision(3)}.` : legend;
    find("reasons").hidden = state.map !== "determined";
  }

  // The sky over the picture: as wide as its shorter side, the light's height above the horizon by its distance.
  const half = Math.min(width, height) / 2;
  const inPicture = ([x, y]) => [0.5 + (x * half) / width, 0.5 - (y * half) / height];
  const inSky = ([column, row]) => {
    const [x, y] = [(column + 0.5 - width / 2) / half, (height / 2 - row - 0.5) / half];
    const share = Math.min(1, 0.999 / Math.hypot(x, y));
    return [x * share, y * share, Math.sqrt(1 - (x * x + y * y) * share * share)];
  };

  function move(event) {
    const pixel = pixelOf(event);
    if (!pixel) return;
    if (canvas.hasPointerCapture(event.pointerId)) {
      state.light0 = inSky(pixel);
      update();
    }
    point(pixel);
  }
  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    move(event);
  });
  canvas.addEventListener("pointermove", move);
  canvas.addEventListener("keydown", (event) => {
    const step = arrow(event);
    if (!step) return;
    event.preventDefault();
    const moved = rotated(rotated(state.light0, [0, 1, 0], step[0]), [1, 0, 0], step[1]);
    if (moved[2] > 0.02) state.light0 = moved;
    update();
  });

  function halves(values, at) {
    return [...values.slice(at, at + 4)].map((bits) => {
      const [power, rest] = [(bits >> 10) & 31, bits & 1023];
      return (bits >> 15 ? -1 : 1) * (power ? 2 ** (power - 15) * (1 + rest / 1024) : 2 ** -24 * rest);
    });
  }

  function point([column, row]) {
    const at = 4 * (row * width + column);
    const [reason, model] = [surface[at + 3] & 7, surface[at + 3] >> 3];
    const place = `column ${left + stride * column}, row ${top + stride * row}`;
    const [d, s] = [halves(k_d, at), halves(k_s, at)];
    const n = 2 ** ((surface[at + 2] * data.octaves) / 65535);
    const said = [`${place}: ${data.models.length > 1 ? `${data.models[model]}, ` : ""}${data.reasons[reason]}`];
    const error = s[3] < 0 ? "" : ` ± ${digits([s[3] * n])}`;
    if (reason !== data.outside)
      said.push(`k_d ${digits(d)}   residual ${digits([d[3]])}`, `k_s ${digits(s)}   n ${digits([n])}${error}`);
    find("pointer").textContent = said.join("\n");
  }

  const take = (read) => Object.assign(state, read, { light0: unit(read.light0 ?? state.light0) });
  const update = begin(state, { load, paint, told: () => state, take, words: { map: names } });
})();
