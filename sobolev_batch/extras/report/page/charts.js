"use strict";
// Charts of a report, drawn by plotly.js from the page's data in the colours of its style sheet.
(async () => {
  const bytes = (text) => Uint8Array.from(atob(text), (character) => character.charCodeAt(0));
  // The page holds plotly.js compressed: it would be most of it. Without it, a note stands for the charts.
  const unpacked = async (text) => {
    const stream = new Blob([bytes(text)]).stream().pipeThrough(new DecompressionStream("gzip"));
    return new Response(stream).text();
  };
  try {
    const script = document.createElement("script");
    script.textContent = await unpacked(document.getElementById("library").textContent);
    document.body.append(script);
  } catch (error) {
    console.warn(`no charts: ${error}`);
  }
  if (typeof Plotly === "undefined") {
    document.documentElement.classList.add("undrawn");
    return;
  }

  const data = JSON.parse(document.getElementById("data").textContent);
  const symbols = ["circle", "square", "diamond", "triangle-up", "triangle-down", "cross", "x"];
  // Named one by one: other buttons would send data to a service.
  const flat = [["toImage", "zoomIn2d", "zoomOut2d", "resetScale2d"]];
  const space = [["toImage", "resetCameraDefault3d"]];
  const viridis = [[0, "#440154"], [0.25, "#3b528b"], [0.5, "#21918c"], [0.75, "#5ec962"], [1, "#fde725"]];
  const state = { order: 0, view: 0, clustered: true, common: false };

  // Plotly interprets a few tags in any text; names must be shown unchanged.
  const plain = (text) => String(text).replaceAll("&", "&amp;").replaceAll("<", "&lt;").replaceAll(">", "&gt;");
  // Cut in their middle: labels of one family differ at their ends.
  const short = (text, most) => plain(
    text.length > most ? `${text.slice(0, Math.ceil((most - 1) / 2))}…${text.slice(-Math.floor((most - 1) / 2))}` : text);
  const color = (name) => getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim();
  const series = (family) => color(`series-${data.families.indexOf(family) % 7}`);
  const symbol = (family) => {
    const i = data.families.indexOf(family);
    return symbols[(i + Math.floor(i / 7)) % 7];
  };
  const number = (value) => (value === null ? "?" : value.toPrecision(4));
  const narrow = () => innerWidth < 700;
  const isSheet = document.body.classList.contains("sheet");
  const isPrinted = () => document.documentElement.classList.contains("printed");

  const layout = (changes) => {
    const axis = { gridcolor: color("line"), zerolinecolor: color("line"), linecolor: color("line"), automargin: true };
    const { xaxis, yaxis, ...others } = changes;
    return {
      paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)",
      font: { family: color("sans"), size: narrow() ? 11 : 13, color: color("ink") },
      margin: { l: 10, r: 10, t: 30, b: 10 },
      hoverlabel: { align: "left", bgcolor: color("raised"), bordercolor: color("line"), font: { color: color("ink") } },
      modebar: { bgcolor: "rgba(0,0,0,0)", color: color("soft"), activecolor: color("accent") },
      legend: { orientation: "h", y: 1.02, yanchor: "bottom", x: 0 },
      xaxis: { ...axis, ...xaxis }, yaxis: { ...axis, ...yaxis, title: { standoff: 14, ...yaxis?.title } },
      ...others,
    };
  };

  const draw = (name, traces, changes, modeBarButtons = flat) => {
    const place = document.getElementById(`chart-${name}`);
    const config = { responsive: true, displaylogo: false, modeBarButtons, displayModeBar: narrow() ? false : "hover" };
    const width = place.closest(".columns") ? 310 : 640;
    const height = Number(place.dataset.height);
    const size = isPrinted() ? { height: isSheet ? 0.62 * height : height, width } : { height };
    Plotly.react(place, traces, layout({ ...size, ...changes }), config);
  };

  // Ticks of a logarithmic axis: powers of ten, with 2 and 5 between them where these are few, and even steps within
  // less than a decade.
  const ticks = (values) => {
    const [least, most] = [Math.min(...values), Math.max(...values)];
    const [low, high] = [Math.log10(least), Math.log10(most)];
    const steps = high - low > 2.5 ? [1] : [1, 2, 5];
    const tickvals = [];
    if (high - low < 0.7 && most > least) {
      const power = 10 ** Math.floor(Math.log10((most - least) / 4));
      const step = power * [1, 2, 5, 10].find((one) => one * power >= (most - least) / 4);
      for (let i = Math.floor(least / step); i <= Math.ceil(most / step); i += 1) {
        if (i > 0) tickvals.push(Number((i * step).toPrecision(6)));
      }
    } else {
      for (let power = Math.floor(low) - 1; power <= Math.ceil(high); power += 1) {
        for (const step of steps) tickvals.push(Number(`${step}e${power}`));
      }
    }
    const plainly = low > -4 && high < 5;
    return { tickvals, ticktext: tickvals.map((x) => (plainly ? String(x) : x.toExponential().replace("-", "−"))) };
  };

  const bars = (values, errors, lower = errors) => ({
    type: "data", symmetric: false, array: errors, thickness: 1, width: 3,
    // Below zero there is no logarithm.
    arrayminus: lower.map((error, i) => Math.min(error, 0.999 * values[i])),
  });

  const marker = (family, size) => ({ color: series(family), symbol: symbol(family), size });
  // The points of a family with their errors, and what is told of each.
  const curve = ({ family, x, y, errors, lower }, text, changes = {}) => ({
    type: "scatter", mode: "lines+markers", name: short(family, 40), x, y, error_y: bars(y, errors, lower),
    line: { color: series(family), width: 1.8 }, marker: marker(family, 8), text: y.map(text), hoverinfo: "text", ...changes,
  });
  const dotted = (name, x, y, shape = "linear") => ({
    type: "scatter", mode: "lines", name, x, y, line: { color: color("soft"), width: 1.2, dash: "dot", shape }, hoverinfo: "skip",
  });
  const logarithmic = (values, text) => ({ type: "log", ...(values.length ? ticks(values) : {}), title: { text } });

  const convergence = () => {
    const families = data.convergence[state.order] ?? [];
    const traces = families.map((line) => curve(line, (value, i) =>
      `${plain(line.labels[i])}<br>${line.triangles[i].toLocaleString("en")} triangles, mean edge ${number(line.x[i])}` +
      `<br>relative distance ${number(100 * value)} % ± ${line.errors[i] == null ? "?" : `${(100 * line.errors[i]).toPrecision(2)} %`}`,
    { mode: line.joined ? "lines+markers" : "markers" }));
    const all = (key) => families.flatMap((line) => line[key]);
    const slope = [];
    if (all("x").length) {
      const middle = (values) => Math.exp(values.reduce((sum, x) => sum + Math.log(x), 0) / values.length);
      const ends = [Math.min(...all("x")), Math.max(...all("x"))];
      const [size, value] = [middle(all("x")), middle(all("y"))];
      slope.push(...ends.map((x) => value * (x / size) ** 2));
      traces.push(dotted("slope 2", ends, slope));
    }
    draw("convergence", traces, {
      xaxis: logarithmic(all("x"), narrow() ? "mean edge length" : `mean edge length in ${plain(data.edge_unit)}`),
      yaxis: logarithmic([...all("y"), ...slope], narrow() ? "" : "relative distance"),
    });
  };

  const league = () => {
    const methods = data.league[state.order];
    const traces = methods.map((line) => curve(line, (value, i) =>
      `${plain(line.family)}<br>${plain(data.size)}: ${number(line.x[i])}<br>mean relative distance ${number(100 * value)} %`));
    draw("league", traces, {
      xaxis: logarithmic(methods.flatMap(({ x }) => x), plain(data.size)),
      yaxis: logarithmic(methods.flatMap(({ y }) => y), narrow() ? "" : "mean relative distance"),
    });
  };

  const costs = () => {
    const { lines, front } = data.costs[state.order];
    const traces = lines.map((line) => curve(line, (value, i) =>
      `${plain(line.family)}/${plain(line.labels[i])}<br>${number(line.x[i])} seconds<br>relative distance ${number(100 * value)} %`,
    { mode: "markers" }));
    draw("costs", [...traces, dotted("front", front.x, front.y, "hv")], {
      xaxis: logarithmic(lines.flatMap(({ x }) => x), "seconds to make the mesh"),
      yaxis: logarithmic(lines.flatMap(({ y }) => y), narrow() ? "" : "relative distance"),
    });
  };

  const evolution = () => {
    const traces = data.evolution[state.order].map((line) => curve(line, (value, i) =>
      `${plain(line.family)}<br>time ${line.x[i]}<br>distance ${number(value)} ± ${line.errors[i] ?? "?"}`,
    { marker: marker(line.family, 6) }));
    draw("evolution", traces, {
      xaxis: { type: "linear", title: { text: "time" } },
      yaxis: { type: "log", dtick: 1, exponentformat: "power", title: { text: narrow() ? "" : "distance" } },
    });
  };

  const matrix = () => {
    const { labels } = data.matrix;
    const { values, errors, clustered } = data.matrix.orders[state.order];
    const at = (table, i, j) => (i > j ? table[i][j] : table[j][i]);
    const arranged = state.clustered ? clustered : labels.map((_, i) => i);
    const cells = (of) => arranged.map((i) => arranged.map((j) => (i === j ? null : of(i, j))));
    const z = cells((i, j) => (at(values, i, j) > 0 ? Math.log10(at(values, i, j)) : null));
    const text = cells((i, j) =>
      `${plain(labels[i])}<br>${plain(labels[j])}<br>${number(at(values, i, j))} ± ${at(errors, i, j) ?? "?"}`);
    const shown = z.flat().filter((value) => value !== null);
    const [low, high] = shown.reduce(([a, b], v) => [Math.min(a, v), Math.max(b, v)], [Infinity, -Infinity]);
    const powers = [];
    for (let power = Math.ceil(low); power <= high; power += 1) powers.push(power);
    // Within one power of ten, ticks at both ends are clearer.
    if (powers.length < 2 && shown.length) powers.splice(0, 1, low, high);
    const room = narrow() ? 14 : 28;
    const named = labels.length <= 60;
    const axis = {
      type: "linear", showgrid: false, zeroline: false, showticklabels: named, ticks: "", constrain: "domain",
      tickvals: labels.map((_, i) => i), ticktext: arranged.map((i) => short(labels[i], room)),
      tickfont: { size: labels.length > 30 ? 9 : 11 },
    };
    draw("matrix", [{
      type: "heatmap", z, text, hoverinfo: "text", colorscale: viridis, xgap: labels.length < 60 ? 1 : 0,
      ygap: labels.length < 60 ? 1 : 0,
      colorbar: {
        title: { text: "distance", side: narrow() ? "top" : "right" }, outlinewidth: 0, thickness: 12,
        tickvals: powers, ticktext: powers.map((v) => (Number.isInteger(v) ? `10<sup>${v}</sup>` : (10 ** v).toPrecision(2))),
        ...(narrow() ? { orientation: "h", y: -0.02, yanchor: "top" } : {}),
      },
    }], {
      height: narrow() ? innerWidth + 20 : 680,
      xaxis: { ...axis, tickangle: -90, side: narrow() ? "top" : "bottom", showticklabels: named && !narrow() },
      yaxis: { ...axis, autorange: "reversed", scaleanchor: "x", scaleratio: 1 },
    });
  };

  const spectrum = () => {
    const { labels, bands, shares } = data.spectrum;
    const z = shares[state.order];
    const [crowded, longest] = [narrow() || bands.length > 6, Math.max(...bands.map((band) => band.length))];
    const percent = (share) => (share === null ? "" : `${(100 * share).toFixed(share < 0.1 ? 1 : 0)} %`);
    draw("spectrum", [{
      type: "heatmap", z, text: z.map((row) => row.map((share) => (share >= 0.005 ? percent(share) : ""))),
      texttemplate: narrow() ? "" : "%{text}", zmin: 0, xgap: 2, ygap: 2, showscale: false,
      colorscale: [[0, color("empty")], [1, color("most")]],
      hovertext: z.map((row, i) => row.map((share, j) => `${plain(labels[i])}<br>wavelengths ${plain(bands[j])}<br>${percent(share)}`)),
      hoverinfo: "text",
    }], {
      // Slanted labels reach beyond the last column, and leave no room for a title, which the caption repeats.
      ...(crowded ? { margin: { l: 10, r: 4 * longest, t: 30 + 7 * longest, b: 10 } } : {}),
      xaxis: {
        side: "top", showgrid: false, ticks: "", tickvals: bands.map((_, j) => j), ticktext: bands.map(plain),
        title: { text: crowded ? "" : `wavelength in ${plain(data.unit)}` }, tickangle: crowded ? -60 : 0,
      },
      yaxis: {
        autorange: "reversed", showgrid: false, zeroline: false, ticks: "", tickvals: labels.map((_, i) => i),
        ticktext: labels.map((label) => short(label, narrow() ? 14 : 30)),
      },
    });
  };

  const energy = () => {
    const wavelengths = data.energy.flatMap(({ x }) => x);
    const families = data.energy.map(({ family }) => family);
    const traces = data.energy.map((line, n) => curve(line, (value, i) =>
      `${plain(line.label)}<br>wavelength ${number(line.x[i])}<br>${number(value)} of the limit`, {
      legendgroup: line.family, showlegend: families.indexOf(line.family) === n,
      line: { color: series(line.family), width: 1.3 }, marker: marker(line.family, 5),
    }));
    draw("energy", [...traces, dotted("limit", [Math.max(...wavelengths), Math.min(...wavelengths)], [1, 1])], {
      xaxis: { autorange: "reversed", ...logarithmic(wavelengths, `wavelength in ${plain(data.unit)}`) },
      yaxis: { type: "log", dtick: 1, exponentformat: "power", title: { text: narrow() ? "" : "energy over its limit" } },
    });
  };

  const hidden = { visible: false, showbackground: false };
  // A mesh whose bounding box has this diagonal is seen whole from the camera, wherever it turns to.
  const scene = (extent, width, height) => {
    const diagonal = 1.5 * Math.min(1, 1.1 * width / height);
    const sides = extent.map((side) => Math.max(side, 1e-3 * Math.hypot(...extent)) * diagonal / Math.hypot(...extent));
    return {
      xaxis: hidden, yaxis: hidden, zaxis: hidden, aspectmode: "manual",
      aspectratio: { x: sides[0], y: sides[1], z: sides[2] },
      camera: { eye: { x: 1.1, y: -1.25, z: 0.7 } }, uirevision: "kept",
    };
  };
  const numbers = ({ bdata }) => new Float32Array(bytes(bdata).buffer);
  // Where values far beyond the colours vary fast, WebGL would draw the mean of all colours: they are cut.
  const mesh = ({ label, points: [x, y, z], corners: [i, j, k] }, values, [low, high], colorscale) => ({
    type: "mesh3d", x, y, z, i, j, k, cmin: low, cmax: high, hoverinfo: "x+y+z+text", colorscale, flatshading: false,
    customdata: numbers(values), intensity: numbers(values).map((one) => Math.min(Math.max(one, low), high)),
    hovertemplate: `${plain(label).replaceAll("%", "&#37;")}<br>%{customdata:.3g}<extra></extra>`,
    lighting: { ambient: 0.8, diffuse: 0.45, specular: 0.08, roughness: 0.8 },
    colorbar: { outlinewidth: 0, thickness: 12, exponentformat: "power", len: 0.8,
      ...(narrow() ? { orientation: "h", y: -0.05, yanchor: "top" } : {}) },
  });
  const diverging = () => [[0, color("less")], [0.5, color("neutral")], [1, color("more")]];

  const witness = () => {
    const view = data.witness[state.view];
    const ends = (state.common ? data.witness : [view]).map(({ limits }) => limits[state.order]);
    const limit = Math.max(...ends);
    const whole = view.triangles.toLocaleString("en");
    document.getElementById("size").textContent = view.shown < view.triangles
      ? `Shown with ${view.shown.toLocaleString("en")} of ${whole} triangles.`
      : `It has ${whole} triangles.`;
    const height = narrow() ? 420 : 560;
    draw("witness", [mesh(view, view.values[state.order], [-limit, limit], diverging())], {
      height, margin: { l: 0, r: 0, t: 0, b: 0 },
      scene: scene(view.extent, document.getElementById("chart-witness").clientWidth, height),
    }, space);
  };

  // Both meshes beside each other, or below each other where it is narrow, turned together.
  const pair = () => {
    const { views, place: [x, y, z], eye, limit, signed } = data.pair;
    const place = document.getElementById("chart-pair");
    const [height, beside] = [isPrinted() ? 195 : narrow() ? 640 : 440, !narrow() || isPrinted()];
    const width = isPrinted() ? 640 : place.clientWidth;
    const colors = signed ? diverging() : [[0, color("neutral")], [1, color("more")]];
    const traces = views.flatMap((view, i) => {
      const own = i ? "scene2" : "scene";
      return [
        { ...mesh(view, view.values[0], [signed ? -limit : 0, limit], colors), scene: own, showscale: !i },
        { type: "scatter3d", mode: "markers", x: [x], y: [y], z: [z], scene: own, showlegend: false, hoverinfo: "text",
          text: ["largest deviation"], marker: { size: 9, symbol: "circle-open", color: color("ink"), line: { width: 3 } } },
      ];
    });
    // On paper the labels of the colours need room of their own.
    const share = isPrinted() ? 0.44 : 0.5;
    if (isPrinted()) traces[0].colorbar.x = 2 * share;
    const scenes = views.map(({ extent }, i) => ({
      ...scene(extent, beside ? share * width : width, beside ? height : height / 2),
      camera: { eye: { x: 1.8 * eye[0], y: 1.8 * eye[1], z: 1.8 * eye[2] } },
      domain: beside ? { x: [share * i, share * (i + 1)], y: [0, 1] } : { x: [0, 1], y: [(1 - i) / 2, (2 - i) / 2] },
    }));
    draw("pair", traces, { height, margin: { l: 0, r: 0, t: 0, b: 0 }, scene: scenes[0], scene2: scenes[1] }, space);
    if (!place.dataset.tied) {
      place.dataset.tied = "yes";
      place.on("plotly_relayout", (changed) => {
        for (const [own, other] of [["scene", "scene2"], ["scene2", "scene"]]) {
          const camera = changed[`${own}.camera`];
          if (camera) Plotly.relayout(place, { [`${other}.camera`]: camera });
        }
      });
    }
  };

  // Red and blue are outside and inside here, and no meshes.
  const histogram = () => {
    const { x, shares } = data.histogram;
    const traces = shares.map((share, i) => ({
      type: "scatter", mode: "lines", name: short(data.families[i], 24), x, y: share.map((one) => one || null),
      line: { color: color(`series-${2 + 3 * i}`), width: 1.8, shape: "hvh" }, hoverinfo: "x+y",
    }));
    draw("histogram", traces, {
      xaxis: { exponentformat: "power", nticks: 6 }, yaxis: { type: "log", tickformat: ".2~%", dtick: 1 },
    });
  };

  const bands = () => {
    const { texts, shares } = data.bands;
    draw("bands", [{ type: "bar", x: texts.map(plain), y: shares, marker: { color: color("most") }, hoverinfo: "x+y" }], {
      xaxis: { type: "category", tickangle: -45 }, yaxis: { tickformat: ".0%", rangemode: "tozero" },
    });
  };

  const drawings = [data.convergence && convergence, data.league?.length && league, data.costs && costs, data.evolution && evolution,
    data.matrix && matrix, data.spectrum && spectrum, data.energy && energy,
    data.witness?.length && witness, data.pair && pair, data.histogram && histogram, data.bands && bands].filter(Boolean);
  const redraw = () => { for (const drawing of drawings) drawing(); };

  document.addEventListener("order", ({ detail }) => { state.order = detail; redraw(); });
  document.getElementById("clustered")?.addEventListener("change", (event) => {
    state.clustered = event.target.checked;
    matrix();
  });
  document.getElementById("common")?.addEventListener("change", (event) => {
    state.common = event.target.checked;
    witness();
  });
  document.getElementById("view")?.addEventListener("change", (event) => {
    state.view = Number(event.target.value);
    witness();
  });
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", redraw);
  // Paper is white, and narrower than most screens.
  for (const name of ["beforeprint", "afterprint"]) {
    addEventListener(name, () => {
      document.documentElement.classList.toggle("printed", name === "beforeprint");
      redraw();
    });
  }
  matchMedia("(max-width: 699px)").addEventListener("change", redraw);
  const chosen = document.querySelector("input[name=order]:checked, #order");
  state.order = chosen ? Number(chosen.value) : 0;
  redraw();
  document.documentElement.classList.add("drawn");
})();
