"use strict";
// Draws the figures of a report from the numbers in the page; follows the colour scheme.
(() => {
  const data = JSON.parse(document.getElementById("data").textContent);
  const LINES = ["--line-1", "--line-2", "--line-3"];
  const SYMBOLS = ["circle", "square", "diamond"];
  const config = { displaylogo: false, responsive: true, displayModeBar: false };
  const figures = [];

  function bytes(text) {
    return Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
  }
  function floats(text) {
    return new Float32Array(bytes(text).buffer);
  }
  function columns(text) {
    const all = floats(text), count = all.length / 3;
    return [0, 1, 2].map((k) => Float32Array.from({ length: count }, (_, i) => all[3 * i + k]));
  }

  function theme() {
    const style = getComputedStyle(document.documentElement);
    return (name) => style.getPropertyValue(name).trim();
  }
  function axis(color, title, more) {
    return Object.assign({
      title: { text: title, font: { size: 12 }, standoff: 6 }, gridcolor: color("--rule"),
      zerolinecolor: color("--muted"), linecolor: color("--rule"), zeroline: false,
      automargin: true, fixedrange: true,
    }, more);
  }
  function layout(color, more) {
    return Object.assign({
      paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)",
      font: { family: getComputedStyle(document.body).fontFamily, size: 12, color: color("--ink") },
      margin: { l: 50, r: 12, t: 10, b: 40 }, showlegend: false,
      hoverlabel: { bgcolor: color("--tint"), bordercolor: color("--rule"), font: { color: color("--ink") } },
    }, more);
  }
  function figure(id, build, options) {
    const element = document.getElementById(id);
    if (element) figures.push({ element, build, options: Object.assign({}, config, options) });
  }
  function drawAll() {
    const color = theme();
    for (const { element, build, options } of figures) {
      const { traces, frame } = build(color);
      Plotly.react(element, traces, frame, options);
    }
  }
  function scale(color) {
    return [[0, color("--low")], [1, color("--high")]];
  }
  function bar(color, title) {
    return {
      title: { text: title, side: "right", font: { size: 12 } }, thickness: 10, len: 0.9,
      outlinewidth: 0, tickfont: { size: 11 },
    };
  }

  // Cells of an image: centres in pixels.
  function centers(size, count) {
    return Array.from({ length: count }, (_, k) => (k + 0.5) * size / count);
  }
  function imageAxes(color, size) {
    return {
      xaxis: axis(color, "x (px)", { range: [0, size[0]], constrain: "domain", showgrid: false }),
      yaxis: axis(color, "y (px)", {
        range: [size[1], 0], constrain: "domain", scaleanchor: "x", showgrid: false,
      }),
    };
  }
  function mapHeight(element, size) {
    const width = document.getElementById(element).clientWidth || 340;
    return Math.min(Math.round((width - 110) * size[1] / size[0]) + 56, 420);
  }
  function residualMap(id, camera, kind, limits) {
    figure(id, (color) => {
      const cells = camera[kind].cells_px, rows = cells.length, count = cells[0].length;
      const x = centers(camera.size[0], count), y = centers(camera.size[1], rows);
      const lines = { x: [], y: [] }, dots = { x: [], y: [] };
      const lengths = cells.map((row, i) => row.map((cell, j) => {
        if (cell[0] === null) return null;
        dots.x.push(x[j]); dots.y.push(y[i]);
        lines.x.push(x[j], x[j] + limits.factor * cell[0], null);
        lines.y.push(y[i], y[i] + limits.factor * cell[1], null);
        return Math.hypot(cell[0], cell[1]);
      }));
      return {
        traces: [
          {
            type: "heatmap", z: lengths, x, y, zmin: 0, zmax: limits.map_px, colorscale: scale(color),
            colorbar: bar(color, "mean (px)"), hoverongaps: false,
            hovertemplate: "%{z:.3f} px<extra></extra>",
          },
          { type: "scatter", mode: "lines", ...lines, line: { color: color("--ink"), width: 1.3 }, hoverinfo: "skip" },
          { type: "scatter", mode: "markers", ...dots, marker: { color: color("--ink"), size: 3 }, hoverinfo: "skip" },
        ],
        frame: layout(color, { height: mapHeight(id, camera.size), ...imageAxes(color, camera.size) }),
      };
    });
  }
  function profiles(id, list, title, unit, limit) {
    figure(id, (color) => ({
      traces: list.map((part, k) => ({
        type: "scatter", mode: "lines+markers", x: part.at, y: part.mean_px,
        error_y: { type: "data", array: part.stderr_px, thickness: 1, width: 2, color: color(LINES[k]) },
        name: `${part.name}, ${part.span.map((v) => Number(v.toPrecision(3))).join(" to ")} ${unit}`,
        line: { color: color(LINES[k]), width: 1.6 },
        marker: { symbol: SYMBOLS[k], size: 6, color: color(LINES[k]) },
        hovertemplate: "%{y:.3f} px<extra>%{fullData.name}</extra>",
      })),
      frame: layout(color, {
        height: 260, showlegend: true,
        legend: { orientation: "h", x: 0, y: 1.02, yanchor: "bottom", font: { size: 11 } },
        xaxis: axis(color, title), yaxis: axis(color, "along radius (px)", { range: [-limit, limit], zeroline: true }),
        margin: { l: 50, r: 12, t: 30, b: 40 },
      }),
    }));
  }
  data.residuals.forEach((camera, index) => {
    const limits = data.scales;
    for (const kind of ["pinhole", "refractive"]) {
      if (camera[kind] === null) continue;
      residualMap(`map-${kind}-${index}`, camera, kind, limits);
      profiles(`radius-${kind}-${index}`, camera[kind].by_radius, "radius (px)", data.unit, limits.profile_px);
      profiles(`depth-${kind}-${index}`, camera[kind].by_depth, `depth (${data.unit})`, "px", limits.profile_px);
    }
    const size = camera.size, id = `coverage-${index}`;
    figure(id, (color) => ({
      traces: [{
        type: "heatmap", z: camera.counts, zmin: 0, colorscale: scale(color),
        x: centers(size[0], camera.counts[0].length), y: centers(size[1], camera.counts.length),
        colorbar: bar(color, "observations"), hovertemplate: "%{z}<extra></extra>",
      }],
      frame: layout(color, { height: mapHeight(id, size), ...imageAxes(color, size) }),
    }));
  });

  (data.halves ?? []).forEach((px, index) => {
    const size = data.residuals[index].size, id = `halves-${index}`;
    figure(id, (color) => ({
      traces: [{
        type: "heatmap", z: px, zmin: 0, zmax: data.halves_limit, colorscale: scale(color),
        x: centers(size[0], px[0].length), y: centers(size[1], px.length), hoverongaps: false,
        colorbar: bar(color, "difference (px)"), hovertemplate: "%{z:.3f} px<extra></extra>",
      }],
      frame: layout(color, { height: mapHeight(id, size), ...imageAxes(color, size) }),
    }));
  });

  figure("cost", (color) => {
    let first = 0;
    const traces = data.solves.map((solve, k) => {
      const y = solve.costs.map((cost) => Math.sqrt(2 * cost / solve.num_observations));
      const x = y.map((_, i) => first + i);
      first += y.length;
      const robust = solve.loss !== "l2", style = color(robust ? "--line-2" : "--line-1");
      return {
        type: "scatter", mode: "lines+markers", x, y, line: { color: style, width: 1.6 },
        marker: { symbol: robust ? "square" : "circle", size: 6, color: style },
        name: robust ? `robust (${solve.loss})` : "least squares",
        showlegend: data.solves.findIndex((other) => other.loss === solve.loss) === k,
        hovertemplate: `%{y:.4f}<extra>${solve.num_observations} observations</extra>`,
      };
    });
    return {
      traces,
      frame: layout(color, {
        height: 300, showlegend: true,
        legend: { orientation: "h", x: 0, y: 1.02, yanchor: "bottom" },
        xaxis: axis(color, "step"), yaxis: axis(color, `cost (${data.cost_unit})`, { type: "log" }),
        margin: { l: 60, r: 12, t: 30, b: 40 },
      }),
    };
  });

  // The scene.
  const element = document.getElementById("cloud");
  const view = data.view, points = columns(view.points);
  const trajectory = columns(view.trajectory), frusta = view.frusta.map(columns);
  const rgb = bytes(view.colors), hex = (v) => v.toString(16).padStart(2, "0");
  const colors = {
    rgb: Array.from({ length: points[0].length }, (_, i) => `#${hex(rgb[3 * i])}${hex(rgb[3 * i + 1])}${hex(rgb[3 * i + 2])}`),
    error: floats(view.error), stddev: floats(view.stddev),
  };
  const titles = { error: "error (px)", stddev: `± of depth (${data.small_unit})` };
  const slider = document.getElementById("size");
  slider.value = points[0].length > 20000 ? 1.5 : 2;
  const state = { colour: "rgb", size: Number(slider.value), hidden: new Set() };

  function xyz(list) {
    return { x: list[0], y: list[1], z: list[2] };
  }
  const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
  const cross = (a, b) => [0, 1, 2].map((k) => {
    const i = (k + 1) % 3, j = (k + 2) % 3;
    return a[i] * b[j] - a[j] * b[i];
  });
  const sub = (a, b, by) => a.map((value, k) => value - by * b[k]);
  const unit = (v) => v.map((value) => value / Math.hypot(...v));
  // What is to be in the frame, in Plotly's units: the longest side of the axes is 1.
  const longest = Math.max(...view.ranges.map(([low, high]) => high - low));
  const drawn = [points, trajectory, ...frusta].flatMap((list) => {
    const step = Math.ceil(list[0].length / 1000);
    return Array.from({ length: Math.ceil(list[0].length / step) }, (_, i) => list.map(
      (values, k) => (values[i * step] - (view.ranges[k][0] + view.ranges[k][1]) / 2) / longest));
  }).filter((place) => place.every(Number.isFinite));
  // From where all of it just is in the frame, with room for the labels of the axes: how
  // far the eye is, what it looks at, and how much of the frame is filled.
  function fitted(away) {
    const up = unit(sub([0, 0, 1], away, away[2])), right = cross(up, away);
    const width = element.clientWidth, height = element.clientHeight;
    const room = 0.09 * Math.min(width, height);
    const slope = 2 * Math.tan(Math.PI / 8) / height; // per pixel: Plotly sees 45 degrees
    const wide = slope * (width / 2 - room), high = slope * (height / 2 - room);
    let center = [0, 0, 0], far = 0, area = 1;
    for (let pass = 0; pass < 10; pass++) {
      const seen = drawn.map((place) => sub(place, center, 1));
      far = Math.max(...seen.map((place) => dot(place, away)
        + Math.max(Math.abs(dot(place, right)) / wide, Math.abs(dot(place, up)) / high)));
      area = 1;
      for (const side of [right, up]) {
        const places = seen.map((place) => dot(place, side) / (far - dot(place, away)));
        const low = Math.min(...places), most = Math.max(...places);
        center = sub(center, side, -far * (low + most) / 2);
        area *= most - low;
      }
    }
    return { away, far, center, area };
  }
  // From above one of the long sides, turned so that the scene fills the frame.
  function firstCamera() {
    const turns = [...Array(13).keys()].map((k) => (k - 6) * Math.PI / 18);
    const { away, far, center } = turns
      .map((turn) => fitted(unit([Math.sin(turn), -Math.cos(turn), 0.55])))
      .reduce((best, next) => next.area > best.area ? next : best);
    return { eye: xyz(sub(center, away, -far)), up: xyz([0, 0, 1]), center: xyz(center) };
  }
  function hover() {
    const ids = new Uint32Array(bytes(view.ids).buffer);
    const span = Math.max(...view.ranges.map(([low, high]) => high - low));
    const digits = Math.max(0, 4 - Math.floor(Math.log10(span)));
    return Array.from(ids, (id, i) => {
      const place = [0, 1, 2].map((k) => view.origin[k]
        + view.axes.reduce((sum, row, a) => sum + row[k] * points[a][i], 0));
      return `point ${id}<br>${place.map((v) => v.toFixed(digits)).join(",")}`;
    });
  }
  function marker(color) {
    const base = { size: state.size, opacity: 1, line: { width: 0 } };
    if (state.colour === "rgb") return Object.assign(base, { color: colors.rgb, showscale: false });
    return Object.assign(base, {
      color: colors[state.colour], colorscale: "Cividis", cmin: view.limits[state.colour][0],
      cmax: view.limits[state.colour][1], showscale: true,
      colorbar: Object.assign(bar(color, titles[state.colour]), { x: 1, xanchor: "right", len: 0.6 }),
    });
  }
  function shown(name) {
    return !state.hidden.has(name);
  }
  let camera = firstCamera();
  const labels = hover();
  figure("cloud", (color) => {
    const traces = [{
      type: "scatter3d", mode: "markers", ...xyz(points), marker: marker(color), text: labels,
      hovertemplate: "%{text}<extra></extra>", visible: shown("points"),
    }];
    frusta.forEach((lines, k) => traces.push({
      type: "scatter3d", mode: "lines", ...xyz(lines), connectgaps: false, hoverinfo: "skip",
      line: { color: color(LINES[k % LINES.length]), width: 1.5 }, visible: shown(`frusta-${k}`),
    }));
    traces.push({
      type: "scatter3d", mode: "lines+markers", ...xyz(trajectory), text: view.names,
      line: { color: color("--ink"), width: 1 }, marker: { size: 2.5, color: color("--ink") },
      hovertemplate: "%{text}<extra></extra>", visible: shown("trajectory"),
    });
    const side = (name, k) => ({
      title: { text: `${name} (${data.unit})` }, range: view.ranges[k], autorange: false,
      gridcolor: color("--rule"), zerolinecolor: color("--rule"), linecolor: color("--rule"),
      showbackground: false, tickfont: { size: 10, color: color("--muted") }, nticks: 6, showspikes: false,
    });
    return {
      traces,
      frame: layout(color, {
        margin: { l: 0, r: 0, t: 0, b: 0 }, uirevision: "scene",
        scene: {
          xaxis: side("x", 0), yaxis: side("y", 1), zaxis: side("z", 2),
          aspectmode: "manual", aspectratio: xyz(view.aspect), camera, dragmode: "orbit",
        },
      }),
    };
  }, { scrollZoom: true });

  drawAll();
  window.matchMedia("(prefers-color-scheme: dark)").addEventListener("change", drawAll);

  function redrawPoints() {
    const points = marker(theme());
    Plotly.restyle(element, { marker: [points] }, [0]);
  }
  for (const input of document.querySelectorAll("input[name=colour]")) {
    input.addEventListener("change", () => { state.colour = input.value; redrawPoints(); });
  }
  slider.addEventListener("input", () => {
    state.size = Number(slider.value);
    Plotly.restyle(element, { "marker.size": state.size }, [0]);
  });
  const order = ["points", ...frusta.map((_, k) => `frusta-${k}`), "trajectory"];
  for (const input of document.querySelectorAll("input[name=show]")) {
    input.addEventListener("change", () => {
      state.hidden[input.checked ? "delete" : "add"](input.value);
      Plotly.restyle(element, { visible: input.checked }, [order.indexOf(input.value)]);
    });
  }
  element.on("plotly_relayout", (change) => {
    if (change["scene.camera"]) camera = change["scene.camera"];
  });
  function look(next) {
    camera = next;
    Plotly.relayout(element, { "scene.camera": next });
  }
  document.getElementById("home").addEventListener("click", () => look(firstCamera()));

  function rotated(v, axis, angle) {
    const c = Math.cos(angle), s = Math.sin(angle), n = Math.hypot(axis.x, axis.y, axis.z);
    const a = { x: axis.x / n, y: axis.y / n, z: axis.z / n };
    const dot = (a.x * v.x + a.y * v.y + a.z * v.z) * (1 - c);
    return {
      x: v.x * c + (a.y * v.z - a.z * v.y) * s + a.x * dot,
      y: v.y * c + (a.z * v.x - a.x * v.z) * s + a.y * dot,
      z: v.z * c + (a.x * v.y - a.y * v.x) * s + a.z * dot,
    };
  }
  element.addEventListener("keydown", (event) => {
    const { center, up } = camera, step = Math.PI / 24;
    const eye = { x: camera.eye.x - center.x, y: camera.eye.y - center.y, z: camera.eye.z - center.z };
    const seen = (v) => ({ x: v.x + center.x, y: v.y + center.y, z: v.z + center.z });
    const side = { x: eye.y * up.z - eye.z * up.y, y: eye.z * up.x - eye.x * up.z, z: eye.x * up.y - eye.y * up.x };
    const nearer = (by) => ({ ...camera, eye: seen({ x: eye.x * by, y: eye.y * by, z: eye.z * by }) });
    const turned = (axis, angle) => ({
      ...camera, eye: seen(rotated(eye, axis, angle)), up: rotated(up, axis, angle),
    });
    const moves = {
      ArrowLeft: () => turned(up, -step), ArrowRight: () => turned(up, step),
      ArrowUp: () => turned(side, step), ArrowDown: () => turned(side, -step),
      "+": () => nearer(0.9), "=": () => nearer(0.9), "-": () => nearer(1 / 0.9),
    };
    if (!(event.key in moves)) return;
    event.preventDefault();
    look(moves[event.key]());
  });

  // Where a table does not fit, each row is a list, whose values are named by the headings.
  const tables = [...document.querySelectorAll(".scroll > table")].filter((table) => table.tHead);
  for (const table of tables) {
    const names = [...table.tHead.rows[0].cells].map(
      (cell) => "bare" in cell.dataset ? "" : `${cell.textContent.trim()} `);
    for (const cell of table.querySelectorAll("tbody td")) cell.dataset.label = names[cell.cellIndex];
  }
  function listWide() {
    for (const table of tables) {
      table.classList.remove("listed");
      const { scrollWidth, clientWidth } = table.parentElement;
      table.classList.toggle("listed", scrollWidth > clientWidth);
    }
  }
  listWide();
  window.addEventListener("resize", listWide);

  // Tables that sort.
  for (const table of document.querySelectorAll("table.sortable")) {
    const headings = [...table.tHead.rows[0].cells], body = table.tBodies[0];
    const key = (row, column) => {
      const cell = row.cells[column], value = cell.dataset.value;
      return value === undefined ? cell.textContent : value === "" ? Infinity : Number(value);
    };
    headings.forEach((heading, column) => heading.firstElementChild.addEventListener("click", () => {
      const up = heading.getAttribute("aria-sort") !== "ascending";
      headings.forEach((other) => other.removeAttribute("aria-sort"));
      heading.setAttribute("aria-sort", up ? "ascending" : "descending");
      const compare = (a, b) => {
        const p = key(a, column), q = key(b, column);
        const order = typeof p === "string" ? p.localeCompare(q, undefined, { numeric: true }) : p - q;
        return up ? order : -order;
      };
      body.append(...[...body.rows].sort(compare));
    }));
  }
  document.documentElement.dataset.drawn = "yes";
})();
