// One viewer: a scene, a view, controls, and a canvas that is drawn only when something has changed.

const MOST_CONTEXTS = 8;  // browsers take back the oldest beyond some 16
const awake = [];  // viewers that hold a context, the one seen last at the end

// The items of a payload, and what follows from where they are. Places are relative to `origin`.
class Scene {
  constructor(payload) {
    if (!payload || payload.version !== 1) throw new Error("RendraViewer: this is no payload of version 1");
    this.items = payload.items.map((item, i) => ({ ...item, visible: true, color: PALETTE[i % PALETTE.length], offset: [0, 0, 0] }));
    const box = boxAround(this.items.filter((item) => item.bounds).map((item) => item.bounds));
    this.origin = box ? scaled(add(box[0], box[1]), 0.5) : [0, 0, 0];
    this.ratio = 1;
    this.version = 0;
    this.arrange(this.crowded());
  }

  // Whether shapes of one kind lie in one another, as versions of one thing do: then they start side by side.
  crowded() {
    const placed = this.items.filter((item) => item.bounds);
    return placed.some((a, i) => placed.slice(i + 1).some((b) => a.kind === b.kind && sharedPart(a.bounds, b.bounds) > 0.3));
  }

  // Items where they are, or middle beside middle in a row along x; lines stay with the first of the others.
  arrange(apart) {
    this.apart = apart;
    for (const item of this.items) item.offset = [0, 0, 0];
    const placed = this.items.filter((item) => item.bounds && item.kind !== "lines");
    if (apart && placed.length) {
      const sides = placed.map((item) => subtract(item.bounds[1], item.bounds[0]));
      const gap = 0.15 * Math.max(...sides.map((side) => Math.max(...side)));
      let left = -(sides.reduce((sum, side) => sum + side[0], 0) + gap * (placed.length - 1)) / 2;
      placed.forEach((item, i) => {
        const middle = subtract(scaled(add(...item.bounds), 0.5), this.origin);
        item.offset = subtract([left + sides[i][0] / 2, 0, 0], middle);
        left += sides[i][0] + gap;
      });
      for (const item of this.items) if (item.kind === "lines") item.offset = placed[0].offset;
    }
    this.measure();
  }

  // The box around what is visible, and the radius around its middle.
  measure() {
    this.version++;
    const there = this.items.filter((item) => item.bounds);
    const shown = there.some((item) => item.visible) ? there.filter((item) => item.visible) : there;
    this.box = boxAround(shown.map((item) => this.placed(item)));
    const [low, high] = this.box || [[-1, -1, -1], [1, 1, 1]];
    this.center = scaled(add(low, high), 0.5);
    const reaches = shown.map((item) => size(subtract(scaled(add(...this.placed(item)), 0.5), this.center)) + item.reach);
    this.radius = Math.min(size(subtract(high, low)) / 2, Math.max(0, ...reaches)) || 1;
    this.reach = size(this.center) + 3 * this.radius;
  }

  placed(item) {
    return item.bounds.map((corner) => add(subtract(corner, this.origin), item.offset));
  }

  heights(up) {
    const axis = up === "y" ? 1 : 2;
    return this.box ? [this.box[0][axis], this.box[1][axis]] : [0, 1];
  }

  // A net of round steps under the box.
  grid(up) {
    const [across, along, height] = up === "y" ? [0, 2, 1] : [0, 1, 2];
    const step = roundStep(this.radius / 5);
    const lines = [];
    const [low, high] = this.box || [[-1, -1, -1], [1, 1, 1]];
    const ends = (axis) => [low[axis] - 0.35 * this.radius, high[axis] + 0.35 * this.radius].map(
      (end, i) => (i ? Math.ceil : Math.floor)((end + this.origin[axis]) / step));
    const point = (a, b) => {
      const p = [0, 0, 0];
      p[across] = a * step - this.origin[across];
      p[along] = b * step - this.origin[along];
      p[height] = low[height] - 1e-3 * this.radius;
      return p;
    };
    const [a0, a1] = ends(across), [b0, b1] = ends(along);
    for (let a = a0; a <= a1; a++) lines.push(...point(a, b0), ...point(a, b1));
    for (let b = b0; b <= b1; b++) lines.push(...point(a0, b), ...point(a1, b));
    return new Float32Array(lines);
  }
}

class Viewer {
  constructor(root, payload, options) {
    this.root = root;
    this.scene = new Scene(payload);
    this.state = {
      look: 0, facets: "auto", faces: true, edges: false, grid: true, axes: true, apart: this.scene.apart, ratio: 1,
      up: payload.up || "y", background: options.background || preferredGround(), pointSize: firstPointSize(this.scene),
    };
    this.view = new View(this.state.up, options);
    this.view.reset(this.scene.center, this.scene.radius);
    this.scheduled = false;
    this.drawing = null;
    this.canvas = element("canvas", { tabIndex: 0 });
    this.canvas.setAttribute("aria-label", "3-D view of " + this.scene.items.map((item) => item.name).join(", "));
    root.classList.add("rendra-viewer");
    root.replaceChildren(this.canvas);
    const actions = this.actions();
    this.panel = new Panel(root, this.scene, this.state, (name, value) => this.set(name, value), actions);
    if (options.controls === false) root.classList.add("rendra-viewer-bare");
    listen(this.canvas, actions);
    this.watch();
    this.panel.update(this.scene, this.state, root);
  }

  actions() {
    const act = (change) => (...values) => { change(...values); this.changed(); };
    return {
      turn: act((dx, dy) => this.view.turn(dx, dy)),
      pan: act((dx, dy) => this.view.pan(dx, dy)),
      zoom: act((factor) => this.view.zoom(factor)),
      focus: act((x, y) => this.focusAt(x, y)),
      show: act((item, visible) => { item.visible = visible; this.scene.measure(); this.refresh(); }),
      paint: act((item, color) => { item.color = color; }),
      press: (key) => this.press(key),
      savePicture: () => this.savePicture(),
    };
  }

  set(name, value) {
    this.state[name] = value;
    if (name === "up") this.view.up = value;
    if (name === "apart") this.scene.arrange(value);
    if (name === "up" || name === "apart") this.view.reset(this.scene.center, this.scene.radius);
    this.refresh();
  }

  refresh() {
    this.panel.update(this.scene, this.state, this.root);
    this.changed();
  }

  press(key) {
    const state = this.state;
    const next = (values, value) => values[(values.indexOf(value) + 1) % values.length];
    const presses = {
      r: () => { this.view.reset(this.scene.center, this.scene.radius); this.changed(); },
      e: () => this.set("edges", !state.edges),
      f: () => this.set("faces", !state.faces),
      s: () => this.set("facets", next(["auto", "smooth", "flat"], state.facets)),
      n: () => this.set("look", state.look === 3 ? 0 : 3),
      l: () => this.set("look", (state.look + 1) % LOOKS.length),
      g: () => this.set("grid", !state.grid),
      a: () => this.set("axes", !state.axes),
      u: () => this.set("up", state.up === "y" ? "z" : "y"),
      b: () => this.set("background", next(Object.keys(BACKGROUNDS), state.background)),
    };
    if (!presses[key]) return false;
    presses[key]();
    return true;
  }

  // Look at what lies under a place of the window, x and y from 0 to 1 from the top left.
  focusAt(x, y) {
    if (!this.drawing) return;
    const [column, row] = [Math.floor(x * this.canvas.width), Math.floor((1 - y) * this.canvas.height)];
    const depth = this.drawing.depthAt(this.view, this.state, column, row);
    if (depth !== null) this.view.lookAt(this.view.placeAt(2 * x - 1, 1 - 2 * y, depth));
  }

  savePicture() {
    this.draw();
    this.canvas.toBlob((blob) => {
      if (!blob) return;
      const address = URL.createObjectURL(blob);
      element("a", { href: address, download: "view.png" }).click();
      setTimeout(() => URL.revokeObjectURL(address), 1000);
    });
  }

  // The canvas follows its element, wakes when it comes into sight, and survives the loss of its context.
  watch() {
    this.canvas.addEventListener("webglcontextlost", (event) => {
      event.preventDefault();
      if (this.drawing) this.drawing.gone = true;
      this.drawing = null;
      if (!this.asleep) this.panel.say("The graphics device is busy elsewhere; the view comes back by itself.");
    });
    this.canvas.addEventListener("webglcontextrestored", () => this.prepare());
    new ResizeObserver(() => this.resize()).observe(this.root);
    window.addEventListener("resize", () => this.resize());  // zooming the page changes pixels alone
    new IntersectionObserver((entries) => {
      this.visible = entries[entries.length - 1].isIntersecting;
      if (this.visible) this.wake();
    }, { rootMargin: "200px" }).observe(this.root);
  }

  wake() {
    const place = awake.indexOf(this);
    if (place >= 0) awake.splice(place, 1);
    awake.push(this);
    const hidden = awake.find((viewer) => !viewer.visible);
    if (awake.length > MOST_CONTEXTS && hidden) hidden.sleep();
    if (this.asleep) {
      this.asleep = false;
      if (this.loser && this.gl.isContextLost()) this.loser.restoreContext();
    } else if (!this.gl) {
      this.gl = this.canvas.getContext("webgl2", { antialias: true, alpha: false, powerPreference: "high-performance" });
      if (!this.gl) return this.explain();
      this.loser = this.gl.getExtension("WEBGL_lose_context");
      this.prepare();
    }
  }

  // Give the context back while out of sight.
  sleep() {
    awake.splice(awake.indexOf(this), 1);
    if (!this.loser) return;
    this.asleep = true;
    this.loser.loseContext();
  }

  explain() {
    this.root.classList.add("rendra-viewer-without");
    this.panel.say("This browser offers no WebGL 2, which the 3-D view needs. " +
      this.scene.items.map((item) => item.name + ": " + countsText(item.counts)).join("; "));
  }

  prepare() {
    if (!this.gl || this.gl.isContextLost()) return;  // lost before this viewer was ever in sight
    this.panel.say(this.scene.box ? "" : this.panel.message.textContent);
    try {
      this.drawing = new Drawing(this.gl, this.scene, () => this.changed());
    } catch (error) {
      this.panel.say("The graphics device cannot draw this: " + error.message);
      throw error;
    }
    this.resize();
    this.changed();
  }

  resize() {
    const ratio = window.devicePixelRatio || 1;
    const width = Math.max(1, Math.round(this.root.clientWidth * ratio));
    const height = Math.max(1, Math.round(this.root.clientHeight * ratio));
    this.state.ratio = this.scene.ratio = ratio;
    this.root.classList.toggle("rendra-viewer-small", this.root.clientWidth < 640);
    if (this.canvas.width !== width || this.canvas.height !== height) {
      this.canvas.width = width;
      this.canvas.height = height;
      this.view.setAspect(width / height);
      this.draw();  // at once: a resized canvas is empty
    }
  }

  changed() {
    if (this.scheduled) return;
    this.scheduled = true;
    requestAnimationFrame(() => {
      this.scheduled = false;
      this.draw();
    });
  }

  draw() {
    if (!this.drawing || this.gl.isContextLost()) return;
    this.drawing.draw(this.view, this.state);
    this.panel.placeAxes(this.view, this.state);
  }
}

function preferredGround() {
  return window.matchMedia("(prefers-color-scheme: dark)").matches ? "dark" : "light";
}

// Few points are drawn large, many small.
function firstPointSize(scene) {
  const most = Math.max(1, ...scene.items.filter((item) => item.kind === "points").map((item) => item.positions.shape[0]));
  return clamp(Math.round(2 * 120 / Math.sqrt(most)) / 2, 1.5, 7);
}

window.RendraViewer = Object.freeze({
  // Fill an element with a view of a payload of `rendra_lab.viewer.scene_payload`.
  // options: yaw and pitch of the first view in degrees; background, a name of BACKGROUNDS; controls, false for none.
  mount(root, payload, options) {
    const viewer = new Viewer(root, payload, options || {});
    return Object.freeze({
      press: (key) => viewer.press(key),
      turn: (yaw, pitch) => { viewer.view.turn(-yaw * Math.PI / 180, pitch * Math.PI / 180); viewer.changed(); },
    });
  },
});
