// The camera of a page, and its controls: mouse, fingers and keys.
'use strict';

const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const unit = v => { const length = Math.hypot(...v); return v.map(x => x / length); };

// Rodrigues: v turned around a unit axis.
function rotated(v, [x, y, z], angle) {
  const c = Math.cos(angle), s = Math.sin(angle), along = (1 - c) * dot(v, [x, y, z]);
  return [
    c * v[0] + s * (y * v[2] - z * v[1]) + along * x,
    c * v[1] + s * (z * v[0] - x * v[2]) + along * y,
    c * v[2] + s * (x * v[1] - y * v[0]) + along * z,
  ];
}

// How many pixels of a picture of this size show one pixel of a camera, if all that the camera sees is to be in it.
const fitted = (camera, width, height) => Math.min(width / camera.width, height / camera.height);

// A camera that rotates around a pivot on its line of sight, zooms, pans, looks around and flies. `up` is the vertical axis of the scene; the
// pivot is at least `near` away when the camera takes the place of a view, and no control moves the camera beyond coordinates of `far`.
class Orbit {
  constructor(view, up = [0, 0, 1], near = 0.1, far = Infinity) {
    Object.assign(this, { up, near, far });
    this.from(view);
  }

  // Takes the place of a view: `pose` has the camera's right, up and backward axes and its position, a row each; `focus` is the distance of what
  // it looks at, if that is known.
  from({ pose, width, height, fx, fy, cx, cy, focus }) {
    Object.assign(this, { width, height, fx, fy, cx, cy, rotation: pose.slice(0, 9), eye: pose.slice(9) });
    // Else the point of the line of sight that is nearest to the middle of the box, if that is in front.
    const away = focus || Math.max(dot(this.eye, this.axis(2)), this.near);
    this.pivot = this.eye.map((p, a) => p - away * this.axis(2)[a]);
  }

  axis(k) { return this.rotation.slice(3 * k, 3 * k + 3); }

  // Tells whether the camera may move there: within `far`, or not farther out than it is.
  holds(eye) {
    const reach = place => Math.max(...place.map(Math.abs));
    return reach(eye) <= Math.max(this.far, reach(this.eye));
  }

  // Distance from the pivot.
  away() { return Math.hypot(...this.eye.map((p, a) => p - this.pivot[a])); }

  // Rotates the axes, and `v` with them, by angles in radians around the vertical and around the horizontal of the image, but not over the
  // poles. Returns the rotated `v`.
  spin(v, right, down) {
    const height = Math.asin(Math.max(-1, Math.min(1, dot(this.axis(2), this.up))));
    if (Math.abs(height + down) > 1.55 && Math.abs(height + down) > Math.abs(height)) down = 0;
    const aside = rotated(this.axis(0), this.up, -right), turn = v => rotated(rotated(v, this.up, -right), aside, -down);
    // Unit and at right angles again, however often it is turned.
    const back = unit(turn(this.axis(2))), side = unit(cross(turn(this.axis(1)), back));
    this.rotation = [...side, ...cross(back, side), ...back];
    return turn(v);
  }

  // Rotates the scene to the right and down, in radians.
  turn(right, down) {
    const { rotation } = this, arm = this.spin(this.eye.map((p, a) => p - this.pivot[a]), right, down);
    const eye = arm.map((p, a) => p + this.pivot[a]);
    if (this.holds(eye)) this.eye = eye; else this.rotation = rotation;
  }

  // Rotates the camera in its place: the scene moves to the right and down, in radians.
  look(right, down) {
    const arm = this.spin(this.pivot.map((p, a) => p - this.eye[a]), -right, -down);
    this.pivot = arm.map((p, a) => p + this.eye[a]);
  }

  zoom(factor) {
    // The camera never reaches the pivot: it would have no distance left to zoom.
    factor = Math.max(0.1, 1e-3 * this.near / this.away(), Math.min(10, factor));
    const eye = this.eye.map((p, a) => this.pivot[a] + (p - this.pivot[a]) * factor);
    if (this.holds(eye)) this.eye = eye;
  }

  // Moves the scene by pixels of the camera.
  shift(right, up) {
    const far = this.away() / this.fx;
    this.fly([-far * right, -far * up, 0]);
  }

  // Moves the camera along its axes (right, up, backward), in units of the world.
  fly(by) {
    const step = [0, 1, 2].map(a => by[0] * this.axis(0)[a] + by[1] * this.axis(1)[a] + by[2] * this.axis(2)[a]);
    const eye = this.eye.map((p, a) => p + step[a]);
    if (!this.holds(eye)) return;
    this.eye = eye;
    this.pivot = this.pivot.map((p, a) => p + step[a]);
  }
}

// Keys that fly, with their direction: right, up, backward.
const FLY = { KeyW: [0, 0, -1], KeyS: [0, 0, 1], KeyA: [-1, 0, 0], KeyD: [1, 0, 0], KeyE: [0, 1, 0], KeyQ: [0, -1, 0] };

// Moves a camera by mouse, fingers and keys of a canvas, and calls `moved` each time.
function control(canvas, camera, moved) {
  const fingers = new Map(), flying = new Set();
  let flies = false;
  const span = () => { const [a, b] = [...fingers.values()]; return Math.hypot(a[0] - b[0], a[1] - b[1]); };
  canvas.addEventListener('pointerdown', e => { canvas.setPointerCapture(e.pointerId); fingers.set(e.pointerId, [e.clientX, e.clientY]); });
  for (const name of ['pointerup', 'pointercancel']) canvas.addEventListener(name, e => fingers.delete(e.pointerId));
  canvas.addEventListener('pointermove', e => {
    const old = fingers.get(e.pointerId);
    if (!old) return;
    const before = fingers.size > 1 && span(), share = 1 / fitted(camera, canvas.clientWidth, canvas.clientHeight);
    const [dx, dy] = [(e.clientX - old[0]) * share, (e.clientY - old[1]) * share];
    fingers.set(e.pointerId, [e.clientX, e.clientY]);
    if (fingers.size > 1) { camera.zoom(before / Math.max(1, span())); camera.shift(dx / 2, -dy / 2); }
    else if (e.shiftKey || e.buttons & 6) camera.shift(dx, -dy);
    else if (e.ctrlKey || e.metaKey) camera.look(dx / camera.fx, dy / camera.fy);
    else camera.turn(Math.PI * dx / camera.height, Math.PI * dy / camera.height);
    moved();
  });
  canvas.addEventListener('wheel', e => { e.preventDefault(); camera.zoom(Math.exp(1e-3 * e.deltaY)); moved(); }, { passive: false });
  canvas.addEventListener('contextmenu', e => e.preventDefault());
  canvas.addEventListener('keydown', e => {
    if (e.ctrlKey || e.metaKey || e.altKey) return;
    const step = { ArrowLeft: [-0.1, 0], ArrowRight: [0.1, 0], ArrowUp: [0, -0.1], ArrowDown: [0, 0.1] }[e.key];
    if (FLY[e.code]) { flying.add(e.code); fly(); }
    else if (step) { camera.turn(...step); moved(); }
    else if (e.key === '+' || e.key === '-') { camera.zoom(e.key === '+' ? 0.9 : 1 / 0.9); moved(); }
    else return;
    e.preventDefault();
  });
  canvas.addEventListener('keyup', e => flying.delete(e.code));
  canvas.addEventListener('blur', () => flying.clear());

  // Flies while keys are down: in a second, most of the way to the pivot.
  function fly() {
    if (flies) return;
    flies = true;
    let last = performance.now();
    const frame = now => {
      const far = 0.8 * Math.max(camera.away(), camera.near) * Math.min(now - last, 100) / 1000;
      last = now;
      flies = flying.size > 0;
      if (!flies) return;
      for (const key of flying) camera.fly(FLY[key].map(x => far * x));
      moved();
      requestAnimationFrame(frame);
    };
    requestAnimationFrame(frame);
  }
}
