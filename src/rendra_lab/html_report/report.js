"use strict";
(() => {
  const SVG = "http://www.w3.org/2000/svg";
  const data = JSON.parse(document.getElementById("report-data").textContent);
  const charts = [];
  const view = { log: false, smooth: 0 };

  function make(name, attributes = {}, ...children) {
    const element = document.createElement(name);
    for (const [key, value] of Object.entries(attributes)) element.setAttribute(key, value);
    element.append(...children);
    return element;
  }

  function draw(parent, name, attributes, text) {
    const element = document.createElementNS(SVG, name);
    for (const [key, value] of Object.entries(attributes)) element.setAttribute(key, value);
    if (text !== undefined) element.textContent = text;
    parent.append(element);
    return element;
  }

  function format(value) {
    if (value === null || value === undefined) return "-";
    const size = Math.abs(value);
    if (size !== 0 && (size < 1e-3 || size >= 1e6)) return Number(value.toPrecision(3)).toExponential().replace("e+", "e");
    return String(Number(value.toPrecision(5)));
  }

  // ---- axes ----------------------------------------------------------------------------------------------

  function linearTicks(low, high, count) {
    const raw = (high - low) / count;
    const power = 10 ** Math.floor(Math.log10(raw));
    const step = [1, 2, 2.5, 5, 10].find((each) => each * power >= raw * 0.999) * power;
    const ticks = [];
    for (let at = Math.ceil(low / step - 1e-9); at * step <= high + step * 1e-9; at += 1) ticks.push(Number((at * step).toPrecision(12)));
    return ticks;
  }

  function logTicks(low, high) {
    const decades = Math.log10(high / low);
    const stride = Math.max(1, Math.ceil(decades / 5));
    const ticks = [];
    for (let power = Math.floor(Math.log10(low)); power <= Math.ceil(Math.log10(high)); power += 1) {
      for (const digit of decades < 1.5 ? [1, 2, 5] : [1]) {
        const tick = digit * 10 ** power;
        if (power % stride === 0 && tick >= low * 0.999 && tick <= high * 1.001) ticks.push(tick);
      }
    }
    return ticks.length > 1 ? ticks : linearTicks(low, high, 4);
  }

  function valueScale(values, wantsLog, from, to) {
    const usable = values.filter((value) => value !== null && (!wantsLog || value > 0));
    const log = wantsLog && usable.length > 0;
    const known = log ? usable : values.filter((value) => value !== null);
    let low = known.reduce((a, b) => Math.min(a, b), Infinity);
    let high = known.reduce((a, b) => Math.max(a, b), -Infinity);
    if (!known.length) [low, high] = [0, 1];
    if (low === high) {
      const widen = log ? 0 : Math.abs(low) * 0.05 || 1;
      [low, high] = log ? [low / 1.2, high * 1.2] : [low - widen, high + widen];
    }
    const place = log ? Math.log : (value) => value;
    const ticks = log ? logTicks(low, high) : linearTicks(low, high, 4);
    const at = (value) => from + ((place(value) - place(low)) / (place(high) - place(low))) * (to - from);
    return { at, ticks, shows: (value) => value !== null && (!log || value >= low * 0.999) };
  }

  // ---- curves --------------------------------------------------------------------------------------------

  // an exponential mean without the pull of its start
  function smoothed(values, weight) {
    let sum = 0;
    let mass = 0;
    return values.map((value) => {
      if (value === null) return null;
      sum = sum * weight + value * (1 - weight);
      mass = mass * weight + (1 - weight);
      return sum / mass;
    });
  }

  function outline(xs, ys, x, y) {
    let path = "";
    let pen = "M";
    xs.forEach((step, index) => {
      if (!y.shows(ys[index])) { pen = "M"; return; }
      path += `${pen}${x.at(step).toFixed(1)} ${y.at(ys[index]).toFixed(1)}`;
      pen = "L";
    });
    return path;
  }

  class Chart {
    constructor(host, spec) {
      this.spec = spec;
      this.readout = make("span");
      this.box = make("div");
      const title = make("h4", {}, make("b", {}, spec.unit ? `${spec.title} [${spec.unit}]` : spec.title), this.readout);
      this.element = make("div", { class: "chart" }, title, this.box);
      host.append(this.element);
      charts.push(this);
    }

    render() {
      const { spec } = this;
      const W = Math.max(260, this.box.clientWidth || 340);
      const H = Math.round(Math.min(W * 0.55, 300));
      const area = { left: 48, right: W - 10, top: 8, bottom: H - 22 };
      this.curves = spec.series.map((each) => ({ ...each, shown: view.smooth > 0 ? smoothed(each.y, view.smooth) : each.y }));
      const x = valueScale(spec.series.flatMap((each) => each.x), false, area.left, area.right);
      const y = valueScale(spec.series.flatMap((each) => each.y), view.log, area.bottom - 4, area.top + 2);
      const svg = document.createElementNS(SVG, "svg");
      svg.setAttribute("viewBox", `0 0 ${W} ${H}`);
      svg.setAttribute("role", "img");
      svg.setAttribute("aria-label", `${spec.title} over ${spec.over}s`);
      for (const tick of y.ticks) {
        draw(svg, "line", { class: "grid", x1: area.left, x2: area.right, y1: y.at(tick), y2: y.at(tick) });
        draw(svg, "text", { x: area.left - 6, y: y.at(tick) + 4, "text-anchor": "end" }, format(tick));
      }
      draw(svg, "line", { class: "axis", x1: area.left, x2: area.right, y1: area.bottom, y2: area.bottom });
      const marks = x.ticks.filter((tick) => Number.isInteger(tick) && x.at(tick) < area.right - 45);
      for (const tick of marks) draw(svg, "text", { x: x.at(tick), y: H - 6, "text-anchor": "middle" }, format(tick));
      const last = x.ticks[x.ticks.length - 1];
      const named = Number.isInteger(last) && x.at(last) >= area.right - 12 ? ` ${format(last)}` : "";
      draw(svg, "text", { x: area.right, y: H - 6, "text-anchor": "end" }, `${spec.over}${named}`);
      for (const curve of this.curves) this.trace(svg, curve, x, y);
      this.listen(svg, x, y, area, W);
      this.box.replaceChildren(svg);
    }

    trace(svg, curve, x, y) {
      const stroke = curve.color || "var(--accent)";
      const job = curve.job === undefined ? {} : { "data-job": curve.job };
      if (view.smooth > 0) draw(svg, "path", { class: "curve raw", stroke, d: outline(curve.x, curve.y, x, y), ...job });
      draw(svg, "path", { class: "curve", stroke, d: outline(curve.x, curve.shown, x, y), ...job });
      if (curve.x.length > 40) return;
      curve.x.forEach((step, index) => {
        if (y.shows(curve.shown[index])) draw(svg, "circle", { cx: x.at(step), cy: y.at(curve.shown[index]), r: 2, fill: stroke, ...job });
      });
    }

    listen(svg, x, y, area, width) {
      const cursor = draw(svg, "g", { visibility: "hidden" });
      svg.addEventListener("pointermove", (event) => {
        const frame = svg.getBoundingClientRect();
        this.point(cursor, ((event.clientX - frame.left) / frame.width) * width, x, y, area);
      });
      svg.addEventListener("pointerleave", () => {
        cursor.setAttribute("visibility", "hidden");
        this.readout.textContent = "";
      });
    }

    point(cursor, where, x, y, area) {
      cursor.replaceChildren();
      cursor.setAttribute("visibility", "visible");
      let best = null;
      const dots = [];
      for (const curve of this.curves) {
        let nearest = -1;
        curve.x.forEach((step, index) => {
          if (y.shows(curve.shown[index]) && (nearest < 0 || Math.abs(x.at(step) - where) < Math.abs(x.at(curve.x[nearest]) - where))) nearest = index;
        });
        if (nearest < 0) continue;
        const step = curve.x[nearest];
        dots.push({ curve, step, value: curve.shown[nearest] });
        if (best === null || Math.abs(x.at(step) - where) < Math.abs(x.at(best) - where)) best = step;
      }
      if (best === null) return;
      draw(cursor, "line", { class: "cursor", x1: x.at(best), x2: x.at(best), y1: area.top, y2: area.bottom });
      for (const { curve, step, value } of dots) draw(cursor, "circle", { cx: x.at(step), cy: y.at(value), r: 3.5, fill: curve.color || "var(--accent)" });
      const words = dots.map(({ curve, value }) => (dots.length > 1 ? `${curve.label}: ${format(value)}` : format(value)));
      this.readout.textContent = `${words.join("  ")} at ${this.spec.over} ${best}`;
    }
  }

  function chartControls(host) {
    const log = make("input", { type: "checkbox" });
    const smooth = make("input", { type: "range", min: 0, max: 0.99, step: 0.01, value: 0 });
    const amount = make("output", {}, "off");
    const refresh = () => {
      view.log = log.checked;
      view.smooth = Number(smooth.value);
      amount.textContent = view.smooth > 0 ? view.smooth.toFixed(2) : "off";
      charts.forEach((chart) => chart.render());
    };
    log.addEventListener("change", refresh);
    smooth.addEventListener("input", refresh);
    host.append(make("label", {}, log, "log scale"), make("label", {}, "smoothing", smooth, amount));
    return { set(wanted) {
      if (wanted.has("log")) log.checked = wanted.get("log") === "1";
      if (wanted.has("smooth")) smooth.value = wanted.get("smooth");
      refresh();
    } };
  }

  // ---- pictures with a slider -----------------------------------------------------------------------------

  class Reel {
    constructor(element) {
      this.figures = [...element.querySelectorAll("figure")];
      this.stepped = this.figures.some((figure) => figure.dataset.step !== undefined);
      if (this.figures.length < 2) { element.classList.add("single-file"); return; }
      element.classList.add("live");
      this.input = make("input", { type: "range", min: 0, max: this.figures.length - 1, step: 1, "aria-label": "which picture" });
      this.output = make("output");
      this.button = make("button", { type: "button" }, "Play");
      this.input.addEventListener("input", () => { this.stop(); this.show(Number(this.input.value)); });
      this.button.addEventListener("click", () => (this.timer ? this.stop() : this.play()));
      element.prepend(make("div", { class: "slider" }, this.button, this.input, this.output));
      this.show(this.stepped ? this.figures.length - 1 : 0);
    }

    show(index) {
      this.figures.forEach((figure, at) => figure.classList.toggle("current", at === index));
      this.input.value = index;
      this.output.textContent = `${index + 1} of ${this.figures.length}`;
    }

    showStep(step) {
      if (!this.input || !this.stepped) return;
      const distance = (figure) => Math.abs(Number(figure.dataset.step) - step);
      let nearest = 0;
      this.figures.forEach((figure, at) => { if (distance(figure) < distance(this.figures[nearest])) nearest = at; });
      this.show(nearest);
    }

    play() {
      this.button.textContent = "Stop";
      this.timer = setInterval(() => this.show((Number(this.input.value) + 1) % this.figures.length), 450);
    }

    stop() {
      clearInterval(this.timer);
      this.timer = null;
      this.button.textContent = "Play";
    }
  }

  // ---- a sweep --------------------------------------------------------------------------------------------

  function sortable(table) {
    const heads = [...table.querySelectorAll("thead th")];
    const body = table.tBodies[0];
    const key = (row, column) => {
      const text = row.cells[column].dataset.value ?? row.cells[column].textContent;
      const number = text.trim() === "" ? NaN : Number(text);
      return Number.isNaN(number) ? text : number;
    };
    const before = (a, b) => {
      const missing = (value) => value === "" || value === "-";
      if (missing(a) || missing(b)) return missing(a) - missing(b);
      if (typeof a === "number" && typeof b === "number") return a - b;
      return String(a).localeCompare(String(b), undefined, { numeric: true });
    };
    heads.forEach((head, column) => {
      head.classList.add("sortable");
      head.tabIndex = 0;
      const sort = () => {
        const down = head.getAttribute("aria-sort") === "ascending";
        heads.forEach((each) => each.removeAttribute("aria-sort"));
        head.setAttribute("aria-sort", down ? "descending" : "ascending");
        const rows = [...body.rows].sort((a, b) => {
          const [left, right] = [key(a, column), key(b, column)];
          const order = before(left, right);
          return down && ![left, right].some((value) => value === "" || value === "-") ? -order : order;
        });
        body.append(...rows);
      };
      head.addEventListener("click", sort);
      head.addEventListener("keydown", (event) => { if (event.key === "Enter" || event.key === " ") { event.preventDefault(); sort(); } });
    });
  }

  function axisOf(name, values, top, bottom) {
    const present = values.filter((value) => value !== null);
    if (present.length && present.every((value) => typeof value === "number")) {
      const low = Math.min(...present);
      const high = Math.max(...present);
      const scale = valueScale(values, low > 0 && high / low >= 30, bottom, top);
      const own = [...new Set(present)].sort((a, b) => a - b);
      const apart = own.every((value, index) => index === 0 || Math.abs(scale.at(value) - scale.at(own[index - 1])) > 12);
      const ticks = apart && own.length <= 8 ? own : scale.ticks;
      return { name, at: (value) => (value === null ? null : scale.at(value)), ticks, words: format };
    }
    const words = [...new Set(present.map(String))].sort((a, b) => a.localeCompare(b, undefined, { numeric: true }));
    const at = (value) => {
      if (value === null) return null;
      const share = words.length > 1 ? words.indexOf(String(value)) / (words.length - 1) : 0.5;
      return bottom + share * (top - bottom);
    };
    return { name, at, ticks: words, words: (word) => (word.length > 22 ? `${word.slice(0, 21)}…` : word) };
  }

  function parallel(host, spec) {
    const select = make("select", { "aria-label": "metric of the last axis" }, ...spec.metrics.map((each) => make("option", {}, each.name)));
    select.selectedIndex = Math.max(0, spec.metrics.findIndex((each) => each.name === spec.aim));
    const box = make("div");
    host.append(make("div", { class: "chart-controls" }, make("label", {}, "last axis", select)), box);
    const render = () => {
      const W = Math.max(420, box.clientWidth);
      const H = 330;
      const chosen = [...spec.settings, spec.metrics[select.selectedIndex]];
      const axes = chosen.map((each) => axisOf(each.name, each.values, 44, H - 22));
      const across = (index) => (axes.length > 1 ? 90 + (index * (W - 210)) / (axes.length - 1) : W / 2);
      const svg = document.createElementNS(SVG, "svg");
      svg.setAttribute("viewBox", `0 0 ${W} ${H}`);
      spec.jobs.forEach((job, row) => {
        let path = "";
        axes.forEach((axis, index) => {
          const at = axis.at(chosen[index].values[row]);
          if (at !== null) path += `${path ? "L" : "M"}${across(index).toFixed(1)} ${at.toFixed(1)}`;
        });
        const line = draw(svg, "path", { class: "curve", stroke: job.color, d: path, "data-job": job.number });
        draw(line, "title", {}, job.label);
      });
      axes.forEach((axis, index) => {
        const x = across(index);
        draw(svg, "line", { class: "axis", x1: x, x2: x, y1: 40, y2: H - 18 });
        draw(svg, "text", { class: "label", x, y: 20, "text-anchor": "middle" }, axis.name);
        for (const tick of axis.ticks) draw(svg, "text", { class: "over", x: x + 6, y: axis.at(tick) + 4 }, axis.words(tick));
      });
      box.replaceChildren(svg);
    };
    select.addEventListener("change", render);
    charts.push({ render });
  }

  function highlight() {
    const mark = (number) => {
      document.body.classList.toggle("dim", number !== null);
      for (const element of document.querySelectorAll("[data-job]")) element.classList.toggle("lit", element.dataset.job === number);
    };
    document.addEventListener("pointerover", (event) => {
      const owner = event.target.closest("[data-job]");
      mark(owner ? owner.dataset.job : null);
    });
  }

  // ---- the page --------------------------------------------------------------------------------------------

  // #step=50&log=1&smooth=0.6&show=scene puts the page into that state: for links, and for tests
  function applyAddress(reels, controls) {
    const wanted = new URLSearchParams(location.hash.slice(1));
    if (controls) controls.set(wanted);
    if (wanted.has("step")) reels.forEach((reel) => reel.showStep(Number(wanted.get("step"))));
    const alone = wanted.get("show");
    for (const part of document.querySelectorAll("main > section")) part.classList.toggle("hidden", alone !== null && part.id !== alone);
  }

  const reels = [...document.querySelectorAll(".reel")].map((element) => new Reel(element));
  for (const swatch of document.querySelectorAll("[data-color]")) swatch.style.background = swatch.dataset.color;
  for (const host of document.querySelectorAll(".charts[data-group]")) data.charts[Number(host.dataset.group)].forEach((spec) => new Chart(host, spec));
  const parallelHost = document.getElementById("parallel-view");
  if (parallelHost) parallel(parallelHost, data.parallel);
  document.querySelectorAll("table.jobs").forEach(sortable);
  if (data.kind === "sweep") highlight();
  const controlsHost = document.querySelector("#curves .chart-controls");
  const controls = controlsHost ? chartControls(controlsHost) : null;
  applyAddress(reels, controls);
  charts.forEach((chart) => chart.render());
  window.addEventListener("hashchange", () => applyAddress(reels, controls));
  let waiting = null;
  window.addEventListener("resize", () => {
    clearTimeout(waiting);
    waiting = setTimeout(() => charts.forEach((chart) => chart.render()), 120);
  });
  const scene = document.getElementById("scene-data");
  if (scene) RendraViewer.mount(document.getElementById("scene-view"), JSON.parse(scene.textContent));
  document.documentElement.dataset.ready = "yes";
})();
