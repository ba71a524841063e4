// The live page: it sends cameras to the program and shows the pictures that come back. It comes after camera.js.
//
// A picture is reduced by a whole factor. While the camera moves, the factor is chosen for FRAME milliseconds per picture; at rest it is halved
// until the picture is sharp. A new camera aborts the request for a finer picture, and the program stops rendering it.

const FRAME = 80, REST = 100, FACTORS = [1, 2, 3, 4, 6, 8, 12, 16];
// In training, a picture at rest is rendered again after AGAIN milliseconds and PATIENCE times the time that it took. It is as sharp as LONGEST
// milliseconds allow. The figures are asked for every ASK milliseconds.
const AGAIN = 3000, PATIENCE = 25, LONGEST = 4000, ASK = 1000;

const pause = milliseconds => new Promise(done => setTimeout(done, milliseconds));
const find = selector => document.querySelector(selector);

class Live {
  constructor(scene) {
    Object.assign(this, { scene, canvas: find('canvas'), status: find('output'), speed: 100, factor: 0, took: 0, dirty: true, ended: false });
    this.context = this.canvas.getContext('2d');
    this.camera = new Orbit(scene.views[0], scene.up, scene.near, scene.far);
    const list = find('#views');
    list.append(...scene.views.map((view, i) => new Option(view.name, i)));
    list.value = 0;
    list.addEventListener('change', () => { this.camera.from(scene.views[list.value]); this.moved(); });
    find('#channel').addEventListener('change', () => this.moved());
    find('#save').addEventListener('click', () => this.save());
    // A camera that has moved is none of the list, so that each of the list can be chosen again.
    control(this.canvas, this.camera, () => { list.selectedIndex = -1; this.moved(); });
    new ResizeObserver(() => this.moved()).observe(this.canvas);
    const scaled = () => matchMedia(`(resolution: ${window.devicePixelRatio}dppx)`).addEventListener('change', () => { this.moved(); scaled(); }, { once: true });
    scaled();
    document.addEventListener('visibilitychange', () => { if (document.hidden && this.refines) this.refines.abort(); });
    this.draw();
  }

  // The picture is no longer that of the camera.
  moved() {
    this.dirty = true;
    if (this.refines) this.refines.abort();
    if (this.wake) this.wake();
  }

  // Waits for so long, or until the camera moves.
  rest(milliseconds) {
    return new Promise(done => {
      this.wake = done;
      if (milliseconds < Infinity) setTimeout(done, milliseconds);
      if (this.dirty) done();
    });
  }

  // Tells whether the picture at rest stays as it is.
  sharp() {
    if (this.factor === 1) return true;
    const [width, height] = this.size(Math.ceil(this.factor / 2));
    return this.scene.training && width * height / this.speed > LONGEST;
  }

  // Asks for pictures, one after the other, as long as the page is open and seen.
  async draw() {
    while (!this.ended) {
      if (document.hidden) {
        await new Promise(done => document.addEventListener('visibilitychange', done, { once: true }));
        this.dirty = true;
      } else if (this.dirty) {
        this.dirty = false;
        const [width, height] = this.size(1), pixels = this.speed * FRAME;
        this.factor = FACTORS.find(factor => width * height / factor ** 2 <= pixels) || FACTORS.at(-1);
        await this.picture(this.factor, null);
      } else if (!this.sharp()) {
        await this.rest(REST);
        if (this.dirty || this.ended) continue;
        this.factor = Math.ceil(this.factor / 2);
        await this.picture(this.factor, this.refines = new AbortController());
      } else {
        await this.rest(this.scene.training ? Math.max(AGAIN, PATIENCE * this.took) : Infinity);
        if (!this.dirty && !this.ended && !document.hidden) await this.picture(this.factor, this.refines = new AbortController());
      }
      this.refines = null;
    }
  }

  // Width and height of a picture that is reduced by a factor.
  size(factor) {
    const ratio = window.devicePixelRatio || 1, [w, h] = [this.canvas.clientWidth * ratio, this.canvas.clientHeight * ratio];
    const shrink = Math.max(1, Math.sqrt(w * h / this.scene.most_pixels)) * factor;
    return [w, h].map(side => Math.max(1, Math.floor(side / shrink)));
  }

  // Asks for a picture and shows it.
  async picture(factor, abort) {
    const [width, height] = this.size(factor), { camera } = this, scale = fitted(camera, width, height), begin = performance.now();
    // The picture's middle stays the middle, whatever the shape of the window.
    const body = JSON.stringify({
      pose: [...camera.rotation, ...camera.eye], width, height, fx: camera.fx * scale, fy: camera.fy * scale,
      cx: camera.cx * scale + 0.5 * (width - scale * camera.width), cy: camera.cy * scale + 0.5 * (height - scale * camera.height),
      channel: find('#channel').value, format: factor > 1 ? 'jpeg' : 'png',
    });
    try {
      const answer = await fetch('picture', { method: 'POST', body, signal: abort && abort.signal });
      if (!answer.ok) throw new Error((await answer.text()).trim());
      const image = await createImageBitmap(await answer.blob()), { canvas } = this, [w, h] = this.size(1);
      if (this.dirty && abort) return image.close();
      if (canvas.width !== w || canvas.height !== h) [canvas.width, canvas.height] = [w, h];
      this.context.drawImage(image, 0, 0, w, h);
      image.close();
      this.took = performance.now() - begin;
      const rendered = Number(/dur=([\d.]+)/.exec(answer.headers.get('Server-Timing'))[1]);
      // Small pictures take some time however small they are.
      this.speed += 0.5 * (width * height / Math.max(1, rendered) - this.speed);
      this.status.textContent = `${width} × ${height} pixels in ${this.took.toFixed(0)} ms, rendered in ${rendered.toFixed(0)} ms`;
    } catch (error) {
      if (error.name === 'AbortError' || this.ended) return;
      this.status.textContent = error instanceof TypeError ? 'the program does not answer; trying again' : error.message;
      await this.rest(AGAIN);
      this.dirty = true;
    }
  }

  save() {
    const link = document.createElement('a');
    link.href = this.canvas.toDataURL('image/png');
    link.download = 'view.png';
    link.click();
  }
}

// Shows the figures of the training, and draws its curves when they have changed.
async function follow(live) {
  find('#training').hidden = false;
  const ask = async (path, method) => {
    const answer = await fetch(path, { method, body: method === 'POST' ? '' : undefined });
    if (!answer.ok) throw new Error((await answer.text()).trim());
    return answer.json();
  };
  let steps = -1;
  const show = state => {
    // An earlier state can come late.
    if (live.ended && state.goes_on) return;
    const decibels = (name, x) => (x === null ? '' : `, ${name} ${x.toFixed(2)} dB`);
    find('#step').textContent = `step ${state.step} of ${state.steps}, ${state.seconds.toFixed(0)} s` +
      decibels('training rays', state.psnr) + decibels('validation views', state.validation_psnr) +
      state.facts.map(([name, value]) => `, ${name} ${value.toLocaleString()}`).join('');
    Object.assign(find('progress'), { max: state.steps, value: state.step });
    find('#message').textContent = state.message || (state.saved === null ? '' : `checkpoint: step ${state.saved}`);
    for (const id of ['#stop', '#checkpoint']) find(id).disabled = !state.goes_on;
    if (state.goes_on && state.step !== steps) for (const id of ['loss', 'psnr']) find(`#${id}`).src = `${id}.svg?${state.step}`;
    steps = state.step;
    if (!state.goes_on) live.ended = true;
  };
  for (const id of ['stop', 'checkpoint']) find(`#${id}`).addEventListener('click', async () => {
    try { show(await ask(id, 'POST')); } catch (error) { live.status.textContent = error.message; }
  });
  // Until the program ends, which writes the figures and the page of the run after the training.
  for (let answers = true; answers || !live.ended;) {
    try { show(await ask('training', 'GET')); answers = true; } catch { answers = false; }
    await pause(answers && !document.hidden ? ASK : 5 * ASK);
  }
}

(async () => {
  try {
    const scene = await (await fetch('scene')).json();
    window.live = new Live(scene);
    if (scene.training) follow(window.live);
  } catch (error) { find('output').textContent = `The scene cannot be shown: ${error.message}`; }
})();
