// The controls over the canvas. Text goes in as text: a name in a payload is never read as HTML.

const KEYS = [
  ["drag", "turn"], ["right drag, shift + drag", "shift"], ["wheel, pinch", "zoom"],
  ["double click", "look at this place"], ["R", "first view"], ["E", "edges"], ["F", "faces"], ["S", "flat or smooth"],
  ["N", "normals"], ["L", "next look"], ["G", "grid"], ["A", "axes"], ["U", "y or z up"], ["B", "background"],
  ["+ −", "zoom"], ["arrows", "turn, with shift shift"], ["Esc", "give the wheel back to the page"],
];

function element(tag, properties, ...children) {
  const made = Object.assign(document.createElement(tag), properties);
  made.append(...children);
  return made;
}

function asHex(color) {
  return "#" + color.map((x) => Math.round(255 * x).toString(16).padStart(2, "0")).join("");
}

function fromHex(text) {
  return [1, 3, 5].map((i) => parseInt(text.slice(i, i + 2), 16) / 255);
}

function grouped(number) {
  return String(number).replace(/\B(?=(\d{3})+$)/g, ",");
}

function countsText(counts) {
  const words = { verts: ["vertex", "vertices"], faces: ["face", "faces"], points: ["point", "points"], cameras: ["camera", "cameras"] };
  return Object.entries(counts).map(([kind, count]) => grouped(count) + " " + words[kind][count === 1 ? 0 : 1]).join(", ");
}

function sizeText(box) {
  if (!box) return "";
  const sides = subtract(box[1], box[0]).map((side) => Number(side.toPrecision(4)).toString());
  return sides.join(" × ");
}

class Panel {
  // `set(name, value)` changes the state, `actions` as in gestures.js.
  constructor(root, scene, state, set, actions) {
    this.set = set;
    this.controls = {};
    this.counts = element("div", { className: "rendra-viewer-counts" });
    this.notes = element("div", { className: "rendra-viewer-notes" });
    this.message = element("div", { className: "rendra-viewer-message", hidden: true });
    this.axes = ["x", "y", "z"].map((name) => element("span", { className: "rendra-viewer-axis", textContent: name }));
    const items = element("div", { className: "rendra-viewer-items" }, ...scene.items.map((item) => this.itemRow(item, actions)));
    const help = element("div", { className: "rendra-viewer-help", hidden: true },
      ...KEYS.map(([keys, meaning]) => element("div", {}, element("b", { textContent: keys }), " " + meaning)));
    this.help = help;
    const left = element("div", { className: "rendra-viewer-left" }, items, this.notes);
    this.bar = element("div", { className: "rendra-viewer-bar" }, ...this.controlsOf(scene, state, actions));
    root.append(left, this.bar, help, this.counts, this.message, ...this.axes);
    this.writeNotes(scene);
  }

  controlsOf(scene, state, actions) {
    const kinds = new Set(scene.items.map((item) => item.kind));
    const meshes = kinds.has("mesh"), points = kinds.has("points");
    return [
      this.choice("look", "look", LOOKS.map((look, i) => [i, look])),
      meshes && this.choice("facets", "faces", [["auto", "auto"], ["smooth", "smooth"], ["flat", "flat"]]),
      meshes && this.box("faces", "fill"),
      meshes && this.box("edges", "edges"),
      points && this.slider("pointSize", "points", 1, 16),
      scene.items.length > 1 && this.box("apart", "side by side"),
      this.box("grid", "grid"),
      this.box("axes", "axes"),
      this.choice("up", "up", [["y", "y"], ["z", "z"]]),
      this.choice("background", "ground", Object.keys(BACKGROUNDS).map((name) => [name, name])),
      this.button("reset", () => actions.press("r")),
      this.button("picture", () => actions.savePicture()),
      this.button("?", () => { this.help.hidden = !this.help.hidden; }),
    ].filter(Boolean);
  }

  itemRow(item, actions) {
    const tick = element("input", { type: "checkbox", checked: item.visible });
    tick.addEventListener("change", () => actions.show(item, tick.checked));
    const swatch = element("input", { type: "color", value: asHex(item.color), title: "colour where the file has none" });
    swatch.addEventListener("input", () => actions.paint(item, fromHex(swatch.value)));
    const name = element("span", { textContent: item.name, title: item.name + ": " + countsText(item.counts) });
    return element("label", {}, tick, swatch, name);
  }

  choice(name, label, options) {
    const select = element("select", {}, ...options.map(([value, text]) => element("option", { value: value, textContent: text })));
    select.addEventListener("change", () => this.set(name, name === "look" ? Number(select.value) : select.value));
    this.controls[name] = (value) => { select.value = String(value); };
    return element("label", {}, label + " ", select);
  }

  box(name, label) {
    const tick = element("input", { type: "checkbox" });
    tick.addEventListener("change", () => this.set(name, tick.checked));
    this.controls[name] = (value) => { tick.checked = value; };
    return element("label", {}, tick, " " + label);
  }

  slider(name, label, low, high) {
    const range = element("input", { type: "range", min: low, max: high, step: 0.5 });
    range.addEventListener("input", () => this.set(name, Number(range.value)));
    this.controls[name] = (value) => { range.value = value; };
    return element("label", {}, label + " ", range);
  }

  button(text, pressed) {
    const made = element("button", { type: "button", textContent: text });
    made.addEventListener("click", pressed);
    return made;
  }

  writeNotes(scene) {
    const notes = scene.items.flatMap((item) => item.notes.map((note) => (scene.items.length > 1 ? item.name + ": " : "") + note));
    this.notes.replaceChildren(...notes.map((note) => element("div", { textContent: note })));
  }

  // Controls show the state; counts and box are those of the visible items.
  update(scene, state, root) {
    for (const [name, write] of Object.entries(this.controls)) write(state[name]);
    const shown = scene.items.filter((item) => item.visible);
    const sums = {};
    for (const item of shown) for (const [kind, count] of Object.entries(item.counts)) sums[kind] = (sums[kind] || 0) + count;
    const box = state.apart ? null : boxAround(shown.filter((item) => item.bounds).map((item) => item.bounds));
    this.counts.textContent = [countsText(sums), sizeText(box)].filter(Boolean).join(" · ");
    root.dataset.ground = state.background === "dark" || state.background === "grey" ? "dark" : "light";
    if (!scene.box) this.say("There is nothing to draw here.");
  }

  // Names at the ends of the axes in the corner.
  placeAxes(view, state) {
    const axes = view.axes();
    this.axes.forEach((label, axis) => {
      const half = AXES_SIDE / 2;
      label.hidden = !state.axes;
      label.style.left = half + 0.88 * half * axes.right[axis] + "px";
      label.style.bottom = half + 0.88 * half * axes.up[axis] + "px";
      label.style.color = asHex(AXIS_COLORS[axis]);
    });
  }

  say(text) {
    this.message.textContent = text;
    this.message.hidden = !text;
  }
}
