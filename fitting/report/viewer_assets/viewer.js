// The page that turns: draws the fitted surface with WebGL2, and lets its numbers, light and view be moved. The scene is
// told as a scene file tells it; here lengths are in units of what is fitted, and the pivot, its middle, is the origin.
// Before this stands page.js.
(() => {
  if (!able) return;

  // -- the scene ----------------------------------------------------------------------------------------------------

  const [, , width, height, stride] = data.window;
  const home = (place) => scaled(add(place, data.pivot, -1), 1 / data.unit);
  const rgb = (values) => data.shown.map((channel) => values[Math.min(channel, values.length - 1)]);

  // Of surface points a ball of radius 1 stands in the middle of what is shown.
  const ball = {
    ...{ position: [0, 0, 4], target: [0, 0, 0], up: [0, 1, 0], perspective: false, local: false },
    resolution: [width, height].map((count, i) => 2 * data.window[i] + stride * (count - 1) + 1),
  };
  ball.half_width = (1.1 * ball.resolution[0]) / (stride * Math.min(width, height));

  function viewed({ position, target, up, ...others }) {
    const forward = unit(add(target, position, -1));
    const right = unit(cross(forward, up));
    const half_width = others.half_width / (others.perspective ? 1 : data.unit);
    return { ...others, forward, right, up: cross(right, forward), position: home(position), half_width };
  }

  function lit(light) {
    // a distant one's place is its direction; one that is no spot has a cone that holds everything
    const kind = ["directional", "point", "spot"].indexOf(light.type);
    const axis = unit(light.direction ?? [0, 0, -1]);
    const cone = [Math.cos(((light.cutoff_angle ?? 180) * Math.PI) / 180), light.exponent ?? 0];
    const place = kind ? home(light.position) : axis;
    return { kind, place, axis, cone, intensity: rgb(light.intensity), attenuation: light.attenuation ?? [1, 0, 0] };
  }

  const own = viewed(data.camera ?? ball);
  const lights = data.lights.map(lit);
  const having = (key) => data.shapes.filter((shape) => key in shape);
  const spheres = having("radius").map((one) => [...home(one.center), one.radius / data.unit, one.fitted]);
  const rectangles = having("edge_u").map((one) => [
    ...[home(one.center), ...[one.edge_u, one.edge_v].map((edge) => scaled(edge, 1 / data.unit))],
    one.fitted,
  ]);

  // -- state --------------------------------------------------------------------------------------------------------

  const fitted = copy(data.material);
  const specular = "n" in fitted;
  const first = {
    yaw: 0,
    pitch: 0,
    shape: "scene",
    selected: 0,
    places: lights.map((light) => light.place),
    exposure: data.exposure,
    srgb: true,
    marked: true,
    wipe: [1 / 3, 2 / 3],
    ...fitted,
  };
  const state = copy(first);
  const moved = () => Object.keys(fitted).some((key) => !same(state[key], fitted[key]));
  const ownView = () => !state.yaw && !state.pitch && state.shape === "scene" && same(state.places, first.places);
  const compared = () => ownView() && (data.drawable || !moved());

  function scale(n) {
    // the constant before the lobe, see brdf.models
    if (!data.weighted) return 1;
    return data.family === "mirror" ? (n + 2) / 2 : ((n + 2) * (n + 4)) / (8 * (2 ** (-n / 2) + n));
  }

  // The state in the address: what differs from the fit. A light's place there is in the scene's own units.
  const worldly = (light, place) => (lights[light].kind ? add(data.pivot, place, data.unit) : place);
  const homely = (light, place) => (lights[light].kind ? home(place) : unit(place));

  function told() {
    const places = state.places.map((place, i) => [`light${i}`, worldly(i, place)]);
    const { places: _, selected, ...others } = state;
    return { ...others, ...Object.fromEntries(places) };
  }

  function take(read) {
    for (const [key, value] of Object.entries(read)) {
      const light = /^light(\d+)$/.exec(key)?.[1];
      if (light === undefined) state[key] = value;
      else state.places[light] = homely(light, value);
    }
    if (!data.camera && (state.yaw || state.pitch || !same(state.places, first.places)) && state.shape === "scene")
      state.shape = "ball";
  }

  // -- what is drawn ------------------------------------------------------------------------------------------------

  const shapes = [
    ["scene", "the scene’s own"],
    ["ball", "ball"],
    ["plane", "plane, near eye"],
  ];
  const counts = {
    SPHERES: Math.max(1, spheres.length),
    RECTANGLES: Math.max(1, rectangles.length),
    LIGHTS: Math.max(1, lights.length),
  };
  const programs = {};
  const corners = ["corner", "corner_a", "corner_b", "corner_c", "normal_a", "normal_b", "normal_c"];

  function program(mesh, probe) {
    const defined = Object.entries(counts).map(([key, count]) => `${key} ${count}`);
    if (mesh) defined.push("MESH");
    if (probe) defined.push("PROBE");
    return (programs[defined] ??= compiled(defined, data.shader.vertex, data.shader.fragment, corners));
  }

  const floats = async (text) => new Float32Array(await unpacked(text));
  const finer = Math.max(1, Math.ceil(512 / Math.max(width, height)));
  let pictures = [];
  let meshes = [];

  async function load() {
    for (const [at, text] of [data.target, data.still].entries()) {
      if (!text) continue;
      pictures[at] = await floats(text);
      texture(at, width, height, [gl.RGBA32F, gl.RGBA, gl.FLOAT], pictures[at]);
    }
    meshes = await Promise.all(
      having("corners").map(async (mesh) => {
        const [corners, normals] = [await floats(mesh.corners), await floats(mesh.normals)];
        const vertices = gl.createVertexArray();
        gl.bindVertexArray(vertices);
        const count = corners.length / 3;
        const values = new Float32Array(21 * count); // a corner, and with it its triangle's three and their normals
        for (let i = 0; i < count; i++) {
          const face = 9 * Math.floor(i / 3);
          values.set(corners.subarray(3 * i, 3 * i + 3), 21 * i);
          values.set(corners.subarray(face, face + 9), 21 * i + 3);
          values.set(normals.subarray(face, face + 9), 21 * i + 12);
        }
        gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
        gl.bufferData(gl.ARRAY_BUFFER, values, gl.STATIC_DRAW);
        for (let i = 0; i < 7; i++) {
          gl.enableVertexAttribArray(i);
          gl.vertexAttribPointer(i, 3, gl.FLOAT, false, 84, 12 * i);
        }
        gl.bindVertexArray(null);
        return { vertices, count, fitted: mesh.fitted };
      }),
    );
  }

  function camera() {
    const turned = (v) => rotated(rotated(v, own.right, state.pitch), own.up, state.yaw);
    const [right, up, forward, position] = [own.right, own.up, own.forward, own.position].map(turned);
    const depth = Math.max(-dot(position, forward), 1e-3);
    const local = own.local || state.shape === "plane"; // for a far eye a plane in far light shows one colour
    return { ...own, local, right, up, forward, position, depth, axis_point: add(position, forward, depth) };
  }

  function geometry() {
    if (state.shape === "ball") return { spheres: [[0, 0, 0, 1, true]], rectangles: [], meshes: [] };
    if (state.shape === "scene") return { spheres, rectangles, meshes };
    const { right, up, forward } = own; // a plane that lies half way back
    return { spheres: [], rectangles: [[[0, 0, 0], right, unit(add(up, forward)), true]], meshes: [] };
  }

  function draw(probe) {
    const comparing = compared();
    const factor = comparing ? 1 : finer;
    if (!probe && (canvas.width !== width * factor || canvas.height !== height * factor)) {
      [canvas.width, canvas.height] = [width * factor, height * factor];
    }
    canvas.classList.toggle("smooth", !comparing);
    const view = camera();
    const [x, y] = data.window;
    const [wide, high] = view.resolution;
    const pixel = (2 * view.half_width) / wide;
    const middle = [
      (x + 0.5 + stride * (width / 2 - 0.5) - wide / 2) * pixel,
      (high / 2 - y - 0.5 - stride * (height / 2 - 0.5)) * pixel,
    ];
    const shown = geometry();
    gl.viewport(...(probe ? [-probe[0], -probe[1]] : [0, 0]), canvas.width, canvas.height);
    gl.enable(gl.DEPTH_TEST);
    gl.depthFunc(gl.LEQUAL);
    gl.clearDepth(1);
    gl.clear(gl.DEPTH_BUFFER_BIT);
    for (const mesh of [null, ...shown.meshes]) {
      const { made, place } = program(Boolean(mesh), Boolean(probe));
      gl.useProgram(made);
      const numbers = {
        pitch: (pixel * stride) / factor,
        depth_of_pivot: view.depth,
        unit: data.unit,
        exposure: 2 ** state.exposure,
        residual_limit: data.residual,
        BRDF_N: state.n,
        BRDF_SCALE: specular ? scale(state.n) : 1,
      };
      const truths = {
        perspective: view.perspective,
        local_viewer: view.local,
        compared: comparing,
        from_still: Boolean(data.still),
        srgb: state.srgb,
        marked: state.marked,
        target: 0,
        still: 1,
        spheres: shown.spheres.length,
        rectangles: shown.rectangles.length,
        lights: lights.length,
        mesh_fitted: mesh?.fitted,
      };
      const triples = {
        axis_point: view.axis_point,
        right: view.right,
        up: view.up,
        forward: view.forward,
        eye: view.position,
        ambient: rgb(data.ambient),
        BRDF_K_A: rgb(state.k_a),
        BRDF_K_D: rgb(state.k_d),
        BRDF_K_S: rgb(state.k_s ?? [0]),
        light_place: state.places.flat(),
        light_intensity: lights.flatMap((light) => light.intensity),
        light_attenuation: lights.flatMap((light) => light.attenuation),
        light_axis: lights.flatMap((light, i) => axis(light, i)),
        light_kind: lights.flatMap((light) => [light.kind, ...light.cone]),
        rectangle: shown.rectangles.flatMap((one) => one.slice(0, 3).flat()),
      };
      uniforms(place, numbers, truths, triples);
      for (const [key, list] of [
        ["sphere_fitted", shown.spheres],
        ["rectangle_fitted", shown.rectangles],
      ])
        if (list.length)
          gl.uniform1iv(
            place(key),
            list.map((one) => Number(one.at(-1))),
          );
      if (shown.spheres.length)
        gl.uniform4fv(
          place("sphere"),
          shown.spheres.flatMap((one) => one.slice(0, 4)),
        );
      gl.uniform2f(place("size"), canvas.width, canvas.height);
      gl.uniform2f(place("middle"), ...middle);
      gl.uniform2f(place("corner_of_probe"), ...(probe ?? [0, 0]));
      gl.uniform2f(place("wipe"), ...state.wipe.map((share) => share * canvas.width));
      gl.bindVertexArray(mesh ? mesh.vertices : null);
      gl.drawArrays(gl.TRIANGLES, 0, mesh ? mesh.count : 3);
    }
  }

  function axis(light, i) {
    // a spot that is moved goes on aiming at what it aimed at
    if (light.kind !== 2 || same(state.places[i], light.place)) return light.axis;
    return unit(add(add(light.place, light.axis, Math.hypot(...light.place)), state.places[i], -1));
  }

  // One pixel's radiance, normal and position, in full precision.
  let framebuffer;
  function probe(column, row) {
    if (!framebuffer) {
      framebuffer = gl.createFramebuffer();
      gl.bindFramebuffer(gl.FRAMEBUFFER, framebuffer);
      const attached = [0, 1, 2].map((i) => {
        const buffer = gl.createRenderbuffer();
        gl.bindRenderbuffer(gl.RENDERBUFFER, buffer);
        gl.renderbufferStorage(gl.RENDERBUFFER, gl.RGBA32UI, 1, 1);
        gl.framebufferRenderbuffer(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0 + i, gl.RENDERBUFFER, buffer);
        return gl.COLOR_ATTACHMENT0 + i;
      });
      const depth = gl.createRenderbuffer();
      gl.bindRenderbuffer(gl.RENDERBUFFER, depth);
      gl.renderbufferStorage(gl.RENDERBUFFER, gl.DEPTH_COMPONENT24, 1, 1);
      gl.framebufferRenderbuffer(gl.FRAMEBUFFER, gl.DEPTH_ATTACHMENT, gl.RENDERBUFFER, depth);
      gl.drawBuffers(attached);
    }
    gl.bindFramebuffer(gl.FRAMEBUFFER, framebuffer);
    draw([column, canvas.height - 1 - row]);
    const [value, normal, position] = [0, 1, 2].map((i) => {
      const bits = new Uint32Array(4);
      gl.readBuffer(gl.COLOR_ATTACHMENT0 + i);
      gl.readPixels(0, 0, 1, 1, gl.RGBA_INTEGER, gl.UNSIGNED_INT, bits);
      return [...new Float32Array(bits.buffer)];
    });
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    return {
      value: value.slice(0, 3),
      normal: normal.slice(0, 3),
      hit: normal[3] > 0.5,
      position: position.slice(0, 3),
    };
  }

  // -- pointer and keys ---------------------------------------------------------------------------------------------

  function toEye(position) {
    const view = camera();
    return view.local ? unit(add(view.position, position, -1)) : scaled(view.forward, -1);
  }

  // The highlight peaks where the light stands in the mirror direction of the view, for either kind of lobe.
  function light_at(seen) {
    const to_view = toEye(seen.position);
    const facing = dot(seen.normal, to_view);
    if (facing <= 0 || !lights.length) return;
    const mirror = unit(add(scaled(seen.normal, 2 * facing), to_view, -1));
    const i = state.selected;
    const apart = Math.hypot(...add(state.places[i], seen.position, -1));
    state.places[i] = lights[i].kind ? add(seen.position, mirror, apart) : mirror;
  }

  function leave_scene() {
    // surface points from a file cannot be turned
    if (!data.camera && state.shape === "scene") state.shape = "ball";
  }

  function turn(yaw, pitch) {
    leave_scene();
    state.yaw = ((state.yaw + yaw + 540) % 360) - 180;
    state.pitch = Math.max(-89, Math.min(89, state.pitch + pitch));
  }

  let drag = null;
  canvas.addEventListener("pointerdown", (event) => {
    const pixel = pixelOf(event);
    if (!pixel) return;
    canvas.setPointerCapture(event.pointerId);
    const seen = data.camera || state.shape !== "scene" ? probe(...pixel) : { hit: false };
    drag = { light: seen.hit, x: event.clientX, y: event.clientY };
    canvas.style.cursor = seen.hit ? "crosshair" : "grabbing";
  });
  canvas.addEventListener("pointermove", (event) => {
    const pixel = pixelOf(event);
    if (!drag) return pixel && point(pixel);
    if (drag.light) {
      const seen = pixel && probe(...pixel);
      if (!seen?.hit) return;
      light_at(seen);
    } else {
      const degrees = 180 / canvas.clientWidth;
      turn((drag.x - event.clientX) * degrees, (drag.y - event.clientY) * degrees);
      [drag.x, drag.y] = [event.clientX, event.clientY];
    }
    update();
    if (pixel) point(pixel);
  });
  for (const end of ["pointerup", "pointercancel"])
    canvas.addEventListener(end, () => {
      drag = null;
      canvas.style.cursor = "";
    });
  canvas.addEventListener("keydown", (event) => {
    const step = arrow(event);
    if (!step) return;
    event.preventDefault();
    if (event.shiftKey && lights.length) {
      leave_scene();
      const [{ right, up }, i] = [camera(), state.selected];
      state.places[i] = rotated(rotated(state.places[i], up, step[0]), right, step[1]);
    } else turn(...step);
    update();
  });

  function point([column, row]) {
    const [x, y] = [column, row].map((at, i) => Math.round(data.window[i] + (stride * at * width) / canvas.width));
    const place = `column ${x}, row ${y}`;
    const comparing = compared();
    let value = data.camera || state.shape !== "scene" ? probe(column, row).value : [0, 0, 0];
    if (!comparing) return void (find("pointer").textContent = `${place}\n${digits(value)}`);
    const at = 4 * (row * width + column);
    const [target, still] = pictures.map((picture) => [...picture.slice(at, at + 4)]);
    if (still) value = still.slice(0, 3);
    const left_out = target[3] > 0.5 ? "" : "  (does not count)";
    find("pointer").textContent =
      `${place}${left_out}\ntarget ${digits(target)}   fit ${digits(value)}\n` +
      `residual ${digits(add(value, target.slice(0, 3), -1))}`;
  }

  // -- the edges between target, fit and residual -------------------------------------------------------------------

  const least = 0.02;
  function wipe_to(i, share) {
    const [low, high] = i ? [state.wipe[0], 1] : [0, state.wipe[1]];
    state.wipe[i] = Math.max(low, Math.min(high, share));
    update();
  }
  [0, 1].forEach((i) => {
    const handle = find(`wipe-${i}`);
    handle.addEventListener("pointerdown", (event) => handle.setPointerCapture(event.pointerId));
    handle.addEventListener("pointermove", (event) => {
      const box = canvas.getBoundingClientRect();
      if (handle.hasPointerCapture(event.pointerId)) wipe_to(i, (event.clientX - box.left) / box.width);
    });
    handle.addEventListener("keydown", (event) => {
      const step = { ArrowLeft: -least, ArrowRight: least }[event.key];
      if (step) wipe_to(i, state.wipe[i] + step);
    });
  });

  function place_wipe() {
    const edges = [0, ...state.wipe, 1];
    const shown = compared();
    [0, 1].forEach((i) => {
      find(`wipe-${i}`).hidden = !shown;
      find(`wipe-${i}`).style.left = `${100 * state.wipe[i]}%`;
      find(`wipe-${i}`).setAttribute("aria-valuenow", Math.round(100 * state.wipe[i]));
    });
    [0, 1, 2].forEach((i) => {
      find(`pane-${i}`).hidden = !shown || edges[i + 1] - edges[i] < 0.12;
      find(`pane-${i}`).style.left = `${50 * (edges[i] + edges[i + 1])}%`;
    });
    find("pane-2").textContent = `residual ± ${data.residual.toPrecision(2)}`;
  }

  // -- numbers ------------------------------------------------------------------------------------------------------

  // Each number of the material; of one that was held in the fit nothing but its value is known.
  const numbers = Object.keys(fitted).flatMap((name) => {
    const channels = name === "n" ? [null] : [...new Set(data.shown)].filter((channel) => channel < fitted[name].length);
    return channels.map((channel) => {
      const told = data.parameters.find((one) => one.name === name && one.channel === channel);
      return told ?? { name, channel, value: name === "n" ? fitted.n : fitted[name][channel] };
    });
  });

  const rows = [];
  function number_row(number) {
    const logarithmic = number.name === "n";
    const most = logarithmic ? 6 : Math.max(1, 1.5 * (number.value ?? 0));
    const [to, from] = logarithmic ? [Math.log10, (x) => 10 ** x] : [(x) => x, (x) => x];
    const low = logarithmic ? -1 : 0;
    const get = () => (logarithmic ? state.n : state[number.name][number.channel]);
    const row = document.createElement("div");
    row.className = "number";
    const label = logarithmic
      ? "n (log)"
      : `${number.name} ${data.channels.length > 1 ? data.channels[number.channel] : ""}`;
    row.innerHTML =
      '<label></label><div class="track"><div class="band"></div><input type="range" step="any"></div>' +
      '<input type="number" step="any" min="0">';
    const [name, track, box] = row.children;
    const [band, range] = track.children;
    name.textContent = label;
    for (const one of [range, box]) one.setAttribute("aria-label", label);
    [range.min, range.max] = [low, most];
    const unknown = number.value === null;
    row.classList.toggle("unknown", unknown);
    for (const one of [range, box]) one.disabled = unknown;
    if (unknown) {
      const reason = document.createElement("span");
      reason.className = "reason";
      reason.textContent = `not determined: ${number.reason}`;
      row.append(reason);
    }
    if (number.interval) {
      const share = (x) => Math.max(0, Math.min(1, (to(Math.max(x, 1e-9)) - low) / (most - low)));
      const [start, end] = number.interval.map((x, i) => (x === null ? i : share(x)));
      // A range's thumb, 16 pixels wide, does not leave the track.
      band.style.left = `calc(8px + ${start} * (100% - 16px) - 1.5px)`;
      band.style.width = `calc(${end - start} * (100% - 16px) + 3px)`;
      row.title = `95 %: ${number.interval.map((x) => (x === null ? "∞" : x.toPrecision(5))).join(" to ")}`;
    } else band.hidden = true;
    const set = (value) => {
      if (!Number.isFinite(value) || value < 0) return;
      if (logarithmic) state.n = Math.min(value, 1e6);
      else state[number.name][number.channel] = value;
      update();
    };
    range.addEventListener("input", () => set(from(Number(range.value))));
    box.addEventListener("change", () => set(Number(box.value)));
    rows.push(() => {
      range.value = to(Math.max(get(), 1e-9));
      if (document.activeElement !== box || drag) box.value = unknown ? "" : +get().toPrecision(6);
    });
    return row;
  }

  // -- lobe, albedo, verdict ----------------------------------------------------------------------------------------

  const at_n = (table) => {
    // between the rows for two exponents as powers of n, which is what lobes come to be
    const grid = data.albedo.log_n;
    const place = Math.max(
      0,
      Math.min(grid.length - 1.000001, (Math.log10(state.n) - grid[0]) / (grid[1] - grid[0])),
    );
    const [i, share] = [Math.floor(place), place % 1];
    return table[i].map((x, j) => x ** (1 - share) * table[i + 1][j] ** share);
  };

  function albedo() {
    // per angle, per channel
    const lobe = specular && state.k_s.some((k) => k > 0) ? at_n(data.albedo.lobe) : null;
    return data.albedo.degrees.map((degrees, i) =>
      state.k_d.map(
        (k, c) =>
          k + (lobe ? (state.k_s[c] * lobe[i]) / (data.weighted ? 1 : Math.cos((degrees * Math.PI) / 180)) : 0),
      ),
    );
  }

  const path = (points, colour, kind = "") =>
    `<path class="${kind}" ${colour ? `stroke="${colour}"` : ""} d="M` +
    `${points.map((point) => point.map((x) => x.toFixed(1)).join(" ")).join("L")}"/>`;
  const label = (x, y, text, anchor = "middle") => `<text x="${x}" y="${y}" text-anchor="${anchor}">${text}</text>`;

  function draw_lobe() {
    const mean = (values) => values.reduce((a, b) => a + b) / values.length;
    const [k_d, k_s, n] = [mean(state.k_d), specular ? mean(state.k_s) : 0, state.n];
    const near = Array.from({ length: 120 }, (_, i) => 1e-3 * 6e4 ** (i / 119));
    const curves = [0, 30, 60].map((angle) => {
      const views = [
        ...Array.from({ length: 181 }, (_, i) => i - 90),
        ...near.flatMap((x) => [angle - x, angle + x]),
        angle,
      ];
      return views
        .filter((view) => Math.abs(view) <= 90)
        .sort((a, b) => a - b)
        .map((view) => {
          const [light, to] = [angle, view].map((x) => (x * Math.PI) / 180);
          const cosine = Math.cos((to - light) / (data.family === "mirror" ? 1 : 2));
          const lobe =
            k_s && cosine > 0
              ? (k_s * scale(n) * Math.exp(n * Math.log(cosine))) / (data.weighted ? 1 : Math.cos(light))
              : 0;
          return [to, Math.sqrt(((k_d + lobe) / Math.PI) * Math.max(Math.cos(to), 0))];
        });
    });
    const longest = Math.max(1e-9, ...curves.flat().map(([, r]) => r));
    const drawn = curves.map((curve, i) =>
      path(
        curve.map(([to, r]) => [100 + (96 * r * Math.sin(to)) / longest, 104 - (96 * r * Math.cos(to)) / longest]),
        ["#0072b2", "#d55e00", "#009e73"][i],
      ),
    );
    find("lobe").innerHTML =
      path(
        [
          [4, 104],
          [196, 104],
        ],
        "",
        "axis",
      ) +
      path(
        [
          [100, 104],
          [100, 8],
        ],
        "",
        "axis",
      ) +
      drawn.join("") +
      label(100, 113, `largest ${(longest ** 2).toPrecision(3)} / sr`);
  }

  function draw_albedo(values) {
    const [x, y] = [(degrees) => 18 + (176 * degrees) / 90, (a) => 100 - 61 * Math.max(0, Math.min(a, 1.5))];
    const colours = data.channels.length > 1 ? ["#d55e00", "#009e73", "#0072b2"] : ["currentColor"];
    const curves = colours.map((colour, c) =>
      path(
        data.albedo.degrees.map((degrees, i) => [x(degrees), y(rgb(values[i])[c])]),
        colour,
      ),
    );
    const ticks =
      [0, 30, 60, 90].map((degrees) => label(x(degrees), 109, `${degrees}°`)).join("") +
      [0, 0.5, 1].map((a) => label(15, y(a) + 2.5, a, "end")).join("");
    find("albedo").innerHTML =
      path(
        [
          [18, 8],
          [18, 100],
          [194, 100],
        ],
        "",
        "axis",
      ) +
      path(
        [
          [18, y(1)],
          [194, y(1)],
        ],
        "",
        "one",
      ) +
      curves.join("") +
      ticks +
      label(20, y(1) - 3, "more than arrives", "start");
  }

  function draw_verdict(values) {
    const glossy = specular && state.k_s.some((k) => k > 0);
    const classic = glossy && !data.weighted;
    const largest = values.map((one) => Math.max(...one));
    const over = largest.findIndex((a) => a > 1 + 1e-6);
    const most = Math.max(...largest);
    const energy =
      over < 0 && !classic
        ? `the albedo is at most ${most.toPrecision(3)}`
        : over === 0
          ? "it reflects more than arrives, at normal incidence already"
          : `the albedo exceeds 1 beyond ${over < 0 ? "89.9" : data.albedo.degrees[over - 1]}° or soon after`;
    const good = !classic && over < 0;
    find("verdict").className = `verdict ${good ? "good" : "bad"}`;
    find("verdict").textContent =
      `${good ? "Plausible" : "Not plausible"}: ` +
      `${classic ? "not reciprocal, the highlight is not multiplied by N·L" : "reciprocal"}; ${energy}.`;
  }

  // -- copies -------------------------------------------------------------------------------------------------------

  const rgb_text = (values) => rgb(values).join(" ");
  const half_exponent = () => (data.family === "mirror" ? 4 * state.n : state.n);

  // The nearest normalised form, as brdf.nearest_normalized finds it: least squares within k_d + k_s <= 1.
  function nearest() {
    if (!specular || data.weighted) return { k_d: state.k_d, k_s: state.k_s ?? state.k_d.map(() => 0) };
    const [a, b, c, u, v] = at_n(data.nearest); // gram [[a, b], [b, c]], cross (u, v)
    const pairs = state.k_d.map((d, i) => {
      const right = [a * d + u * state.k_s[i], b * d + v * state.k_s[i]];
      const free = [c * right[0] - b * right[1], a * right[1] - b * right[0]].map((x) => x / (a * c - b * b));
      if (Math.min(...free) >= 0 && free[0] + free[1] <= 1) return free;
      const cost = ([x, y]) => 0.5 * (a * x * x + 2 * b * x * y + c * y * y) - right[0] * x - right[1] * y;
      const edges = [
        [
          [0, 0],
          [1, 0],
        ],
        [
          [0, 0],
          [0, 1],
        ],
        [
          [0, 1],
          [1, -1],
        ],
      ].map(([[x, y], [p, q]]) => {
        const step =
          (p * (right[0] - a * x - b * y) + q * (right[1] - b * x - c * y)) / (a * p * p + 2 * b * p * q + c * q * q);
        const t = Math.max(0, Math.min(1, step));
        return [x + t * p, y + t * q];
      });
      return edges.reduce((best, one) => (cost(one) < cost(best) ? one : best));
    });
    return { k_d: pairs.map(([d]) => d), k_s: pairs.map(([, s]) => s) };
  }

  const writers = {
    json: () => {
      const values = Object.keys(fitted).map((key) => [key, state[key]]);
      return `${JSON.stringify({ model: data.model, ...Object.fromEntries(values) }, null, 2)}\n`;
    },
    mtl: () =>
      [
        "# Wavefront material, linear values",
        ...(data.model === "blinn-phong" ? [] : [`# brdf model: ${data.model}`]),
        "newmtl fitted",
        ...(specular ? [`Ns ${half_exponent()}`] : []),
        `Ka ${rgb_text(state.k_a)}`,
        `Kd ${rgb_text(state.k_d)}`,
        `Ks ${rgb_text((state.k_s ?? [0]).map((k) => k * scale(state.n ?? 0)))}`,
        `illum ${specular ? 2 : 1}`,
        "",
      ].join("\n"),
    glsl: () => {
      const number = (x) => {
        const text = String(+x.toPrecision(9));
        return /[.e]/.test(text) ? text : `${text}.0`;
      };
      const values = { N: number(state.n ?? 0), SCALE: number(scale(state.n ?? 0)) };
      for (const key of ["k_a", "k_d", "k_s"])
        values[key.toUpperCase()] = `vec3(${rgb(state[key] ?? [0])
          .map(number)
          .join(", ")})`;
      return data.formats.glsl.text.replace(
        /(const \w+ BRDF_(\w+) = )[^;]*;/g,
        (_, before, key) => `${before}${values[key]};`,
      );
    },
    three: () => {
      const material = JSON.parse(data.formats.three.text);
      const { k_d, k_s } = nearest();
      const n = specular ? half_exponent() : 30;
      const plausible_scale =
        data.family === "mirror"
          ? (state.n + 2) / 2
          : ((state.n + 2) * (state.n + 4)) / (8 * (2 ** (-state.n / 2) + state.n));
      const linear = {
        color: rgb(k_d),
        specular: rgb(k_s).map((k) => (specular ? (k * plausible_scale * 8) / (n + 2) : 0)),
      };
      const code = (x) => Math.round(255 * (x <= 0.0031308 ? 12.92 * x : 1.055 * x ** (1 / 2.4) - 0.055));
      for (const [key, colour] of Object.entries(linear))
        material[key] = colour.reduce((all, x) => 256 * all + code(Math.max(0, Math.min(1, x))), 0);
      Object.assign(material, { shininess: n, userData: { linear, losses: material.userData.losses } });
      return `${JSON.stringify(material, null, 2)}\n`;
    },
  };

  async function copy_as(format) {
    const { text: exact, losses } = data.formats[format];
    const text = exact && moved() ? writers[format]() : exact;
    find("copied").hidden = false;
    find("text").hidden = !text;
    find("text").value = text;
    items(find("losses"), losses);
    if (!text) return void (find("said").textContent = "");
    let done = true;
    try {
      await navigator.clipboard.writeText(text);
    } catch {
      find("text").select();
      done = document.execCommand("copy");
    }
    const lost = losses.length
      ? `It cannot carry everything${moved() ? "; what is lost at the fitted numbers" : ""}:`
      : "It carries everything.";
    find("said").textContent = `${done ? "Copied." : "Select and copy the text below."} ${lost}`;
  }

  // -- putting it together ------------------------------------------------------------------------------------------

  function paint() {
    draw();
    place_wipe();
    for (const row of rows) row();
    const values = albedo();
    draw_lobe();
    draw_albedo(values);
    draw_verdict(values);
    [find("shape").value, find("light").value] = [state.shape, state.selected];
    find("own").disabled = ownView();
    find("reset").disabled = !moved();
  }

  async function start() {
    await load();
    options(find("shape"), shapes);
    options(
      find("light"),
      lights.map((light, i) => [i, `${i + 1}: ${data.lights[i].type}`]),
    );
    find("light-label").hidden = lights.length < 2;
    find("model").textContent = data.model;
    find("sliders").append(...numbers.map(number_row));
    find("shape").addEventListener("change", (event) => {
      state.shape = event.target.value;
      if (!data.camera && state.shape === "scene") to_own();
      update();
    });
    find("light").addEventListener("change", (event) => {
      state.selected = Number(event.target.value);
    });
    find("reset").addEventListener("click", () => {
      Object.assign(state, copy(fitted));
      update();
    });
    find("own").addEventListener("click", () => {
      to_own();
      update();
    });
    for (const button of document.querySelectorAll("[data-format]"))
      button.addEventListener("click", () => copy_as(button.dataset.format));
    find("why").textContent = "Target and fit in the fit’s own view and light, as they were computed.";
  }

  function to_own() {
    Object.assign(state, { yaw: 0, pitch: 0, shape: "scene", places: copy(first.places) });
  }

  const words = { shape: shapes.map(([name]) => name) };
  const update = begin(state, { load: start, paint, told, take, words });
})();
