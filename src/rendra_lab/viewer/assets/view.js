// Where the eye is: a turntable around a target. Angles in radians, places relative to the scene's origin.

const TANGENT = Math.tan(Math.PI / 9);  // of half the vertical angle of view, 40 degrees in all
const FRAMES = {  // what points right, up and towards the eye when both angles are 0
  y: { right: [1, 0, 0], up: [0, 1, 0], back: [0, 0, 1] },
  z: { right: [1, 0, 0], up: [0, 0, 1], back: [0, -1, 0] },
};
const START = { yaw: Math.PI / 6, pitch: Math.PI / 9 };
const STEEPEST = Math.PI / 2;

class View {
  constructor(up, options) {
    this.up = up;
    this.start = {
      yaw: options.yaw === undefined ? START.yaw : options.yaw * Math.PI / 180,
      pitch: options.pitch === undefined ? START.pitch : options.pitch * Math.PI / 180,
    };
    this.aspect = 1;
    this.reset([0, 0, 0], 1);
  }

  // Look at a ball from the first direction, so that it fills the window.
  reset(target, radius) {
    this.target = target;
    this.radius = radius > 0 ? radius : 1;
    Object.assign(this, this.start);
    this.fit();
  }

  fit() {
    this.distance = this.fitting();
  }

  fitting() {
    const half = Math.atan(TANGENT * Math.min(1, this.aspect));
    return 1.06 * this.radius / Math.sin(half);
  }

  // A wider or narrower window shows the same as long as nobody has zoomed.
  setAspect(aspect) {
    const untouched = Math.abs(this.distance / this.fitting() - 1) < 1e-6;
    this.aspect = aspect;
    if (untouched) this.fit();
  }

  axes() {
    const frame = FRAMES[this.up];
    const level = add(scaled(frame.right, Math.sin(this.yaw)), scaled(frame.back, Math.cos(this.yaw)));
    const right = add(scaled(frame.right, Math.cos(this.yaw)), scaled(frame.back, -Math.sin(this.yaw)));
    const back = add(scaled(level, Math.cos(this.pitch)), scaled(frame.up, Math.sin(this.pitch)));
    return { right: right, up: cross(back, right), back: back };
  }

  eye() {
    return add(this.target, scaled(this.axes().back, this.distance));
  }

  // World to clip. Near is a share of the distance, far behind all that there is.
  matrix(reach) {
    const axes = this.axes();
    const eye = this.eye();
    const far = size(eye) + reach + this.distance;
    const near = Math.max(this.distance * 0.01, (size(eye) - reach) * 0.5, far * 1e-5);
    this.depths = [near, far];
    return product(perspective(TANGENT, this.aspect, near, far), rigid(axes.right, axes.up, axes.back, eye));
  }

  turn(dx, dy) {
    this.yaw -= dx;
    this.pitch = clamp(this.pitch + dy, -STEEPEST, STEEPEST);
  }

  // Shift by shares of the window's height.
  pan(dx, dy) {
    const axes = this.axes();
    const whole = 2 * TANGENT * this.distance;
    this.target = add(this.target, add(scaled(axes.right, -dx * whole), scaled(axes.up, dy * whole)));
  }

  zoom(factor) {
    this.distance = clamp(this.distance * factor, this.radius * 1e-3, this.radius * 100);
  }

  // Turn around another place from now on; the eye moves sideways alone, so that nothing grows or shrinks.
  lookAt(place) {
    this.distance = dot(subtract(this.eye(), place), this.axes().back);
    this.target = place;
    this.zoom(1);
  }

  // The place at a depth of the window (x and y from -1 to 1, depth from 0 to 1).
  placeAt(x, y, depth) {
    const [near, far] = this.depths;
    const away = 2 * near * far / (far + near - (2 * depth - 1) * (far - near));
    const axes = this.axes();
    const aside = add(scaled(axes.right, x * TANGENT * this.aspect * away), scaled(axes.up, y * TANGENT * away));
    return add(this.eye(), add(aside, scaled(axes.back, -away)));
  }
}
