// The viewer: ray casting of the trained grid in a fragment shader.
//
// It uses the samples of the program (`plenoxel/src/sampling.rs`): intervals of equal length from the entry of a ray into the box, colors and
// densities at their midpoints, alpha = 1 - exp(-density length). The grid of a capture is one of normalized device coordinates, or of the
// contracted world, in which rays are bent (`plenoxel/src/space.rs`, `plenoxel/src/field/voxel_grid/grid_space.rs`). Voxels are stored in an atlas of bricks of 4^3 cells, which have 5^3 corners,
// so that the hardware interpolates. A table of links has the place of each brick, or for an empty brick the distance to the nearest one.
'use strict';

const BRICK = 4, CORNERS = BRICK + 1;

// Bytes of the page to a typed array.
async function unpack(base64) {
  const text = atob(base64), packed = new Uint8Array(text.length);
  for (let i = 0; i < packed.length; i++) packed[i] = text.charCodeAt(i);
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream('deflate'));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

// The places of nodes: for each brick its number among those that have nodes, or -1; for each of its nodes the number of its value, or -1.
function readPlaces(reader, resolution) {
  const side = Math.ceil(resolution / BRICK), bricks = side ** 3;
  const bits = reader.take(Math.ceil(bricks / 8)), numbers = new Int32Array(bricks).fill(-1);
  let count = 0;
  for (let b = 0; b < bricks; b++) if (bits[b >> 3] >> (b & 7) & 1) numbers[b] = count++;
  const masks = reader.take(8 * count), values = new Int32Array(64 * count).fill(-1);
  let next = 0;
  for (let node = 0; node < values.length; node++) if (masks[node >> 3] >> (node & 7) & 1) values[node] = next++;
  return { resolution, side, numbers, values };
}

// The number of a brick, or -1 if it has no nodes.
const brickAt = ({ side, numbers }, x, y, z) => (x < side && y < side && z < side ? numbers[(x * side + y) * side + z] : -1);

// The number of a node's value, or -1 if there is no such node.
function valueAt(places, x, y, z) {
  const brick = brickAt(places, x >> 2, y >> 2, z >> 2);
  return brick < 0 ? -1 : places.values[64 * brick + 16 * (x & 3) + 4 * (y & 3) + (z & 3)];
}

// The atlas of the bricks whose cells have a node that `counts`. `each` visits its texels: their place, and the number of their value.
// No side of the texture is longer than `most`, even if `slabs` atlases lie one behind the other.
function buildAtlas(places, counts, most, slabs = 1) {
  const { side } = places, links = new Uint32Array(side ** 3), bricks = [], corners = new Int32Array(CORNERS ** 3);
  for (let b = 0, x = 0; x < side; x++) for (let y = 0; y < side; y++) for (let z = 0; z < side; z++, b++) {
    let any = false, near = false;
    for (let c = 0; c < 8 && !near; c++) near = brickAt(places, x + (c >> 2), y + (c >> 1 & 1), z + (c & 1)) >= 0;
    if (near) for (let c = 0, i = 0; i < CORNERS; i++) for (let j = 0; j < CORNERS; j++) for (let k = 0; k < CORNERS; k++, c++) {
      corners[c] = valueAt(places, BRICK * x + i, BRICK * y + j, BRICK * z + k);
      any = any || (corners[c] >= 0 && counts(corners[c]));
    }
    if (any) { bricks.push(corners.slice()); links[b] = bricks.length; }
  }
  const deepest = Math.floor(most / CORNERS / slabs);
  const across = Math.max(1, Math.ceil(Math.cbrt(bricks.length)), Math.ceil(Math.sqrt(bricks.length / deepest)));
  const deep = Math.max(1, Math.ceil(bricks.length / across ** 2));
  if (CORNERS * across > most) throw new Error('the grid is too large for the textures of this browser');
  const size = [CORNERS * across, CORNERS * across, CORNERS * deep];
  markDistances(links, side);
  for (let b = 0; b < links.length; b++) if (!(links[b] & DISTANCE)) {
    const n = links[b] - 1, x = n % across, y = Math.floor(n / across) % across, z = Math.floor(n / across ** 2);
    links[b] = x | y << 10 | z << 20;
  }
  const each = visit => bricks.forEach((values, n) => {
    const x0 = CORNERS * (n % across), y0 = CORNERS * (Math.floor(n / across) % across), z0 = CORNERS * Math.floor(n / across ** 2);
    for (let c = 0, i = 0; i < CORNERS; i++) for (let j = 0; j < CORNERS; j++) for (let k = 0; k < CORNERS; k++, c++)
      if (values[c] >= 0) visit(((z0 + k) * size[1] + y0 + j) * size[0] + x0 + i, values[c]);
  });
  return { links, side, size, each };
}

// Marks a link to nothing, of which the lower bits say how many bricks away the nearest brick is.
const DISTANCE = 1 << 31, FAR = 16;

// Chebyshev distances, axis by axis: what is within d of a brick along all axes is within d.
function markDistances(links, side) {
  let near = new Uint8Array(links.length);
  for (let b = 0; b < links.length; b++) near[b] = links[b] ? 0 : FAR;
  for (const stride of [1, side, side * side]) {
    const out = near.slice();
    for (let b = 0; b < links.length; b++) {
      const at = Math.floor(b / stride) % side;
      let best = near[b];
      for (let d = 1; d < best; d++) {
        if (at >= d) best = Math.min(best, Math.max(d, near[b - d * stride]));
        if (at + d < side) best = Math.min(best, Math.max(d, near[b + d * stride]));
      }
      out[b] = best;
    }
    near = out;
  }
  for (let b = 0; b < links.length; b++) if (!links[b]) links[b] = (DISTANCE | near[b]) >>> 0;
}

// A number as a half float, the nearest.
const float = new Float32Array(1), floatBits = new Uint32Array(float.buffer);
function half(x) {
  float[0] = x;
  const bits = floatBits[0] + 0x1000, sign = bits >> 16 & 0x8000, exponent = (bits >> 23 & 255) - 112;
  if (exponent <= 0) return exponent < -10 ? sign : sign | (bits & 0x7fffff | 0x800000) >> 14 - exponent;
  return exponent > 30 ? sign | 0x7bff : sign | exponent << 10 | bits >> 13 & 0x3ff;
}

// The textures of a grid from its bytes: mean colors and densities as half floats, and harmonics as bytes, four to a texel, in slabs.
function readGrid(grid, bytes, most) {
  let at = 0;
  const reader = { take: n => bytes.subarray(at, at += n) };
  const places = readPlaces(reader, grid.resolution), n = grid.voxels;
  const low = reader.take(n), high = reader.take(n), means = [0, 1, 2].map(() => reader.take(n));
  const dense = v => high[v] < 128 && (high[v] | low[v]) > 0;
  const atlas = buildAtlas(places, dense, most);
  const y0 = grid.degree === null ? 1 : 0.28209479177387814;
  const table = means.map((_, c) => Uint16Array.from({ length: 256 }, (_, b) => half(y0 * (grid.zeros[c] + b * grid.steps[c]))));
  const texels = new Uint16Array(4 * atlas.size[0] * atlas.size[1] * atlas.size[2]);
  atlas.each((place, v) => {
    for (let c = 0; c < 3; c++) texels[4 * place + c] = table[c][means[c][v]];
    texels[4 * place + 3] = low[v] | high[v] << 8;
  });
  return { atlas, texels, harmonics: grid.harmonics ? readHarmonics(grid.harmonics, reader, places, most) : null };
}

function readHarmonics({ resolution, reduction, voxels, steps }, reader, places, most) {
  const own = reduction === 1 ? places : readPlaces(reader, resolution), slabs = Math.ceil(steps.length / 4);
  const values = steps.map(() => reader.take(voxels)), atlas = buildAtlas(own, () => true, most, slabs);
  const [w, h, d] = atlas.size, slab = 4 * w * h * d, texels = new Uint8Array(slabs * slab).fill(128);
  atlas.each((place, v) => values.forEach((bytes, f) => { texels[(f >> 2) * slab + 4 * place + (f & 3)] = bytes[v]; }));
  return { atlas, texels, slabs };
}

const PASS = `#version 300 es
void main() { gl_Position = vec4(vec2(gl_VertexID & 1, gl_VertexID >> 1) * 4.0 - 1.0, 0.0, 1.0); }`;

// The harmonics of degree 1 and more at a unit direction d, in the program's order and signs.
const BASIS = [
  '-0.4886025119 * d.y', '0.4886025119 * d.z', '-0.4886025119 * d.x',
  '1.0925484306 * d.x * d.y', '-1.0925484306 * d.y * d.z', '0.3153915653 * (2.0 * d.z * d.z - d.x * d.x - d.y * d.y)',
  '-1.0925484306 * d.x * d.z', '0.5462742153 * (d.x * d.x - d.y * d.y)',
  '-0.5900435899 * d.y * (3.0 * d.x * d.x - d.y * d.y)', '2.8906114426 * d.x * d.y * d.z',
  '-0.4570457995 * d.y * (4.0 * d.z * d.z - d.x * d.x - d.y * d.y)',
  '0.3731763326 * d.z * (2.0 * d.z * d.z - 3.0 * d.x * d.x - 3.0 * d.y * d.y)',
  '-0.4570457995 * d.x * (4.0 * d.z * d.z - d.x * d.x - d.y * d.y)', '1.4453057213 * d.z * (d.x * d.x - d.y * d.y)',
  '-0.5900435899 * d.x * (d.x * d.x - 3.0 * d.y * d.y)',
];

// The space of the grid's box: box, ndc or contracted.
const spaceOf = ({ coordinates: { space } }) => (typeof space === 'string' ? space : Object.keys(space)[0]);
// The length of a step in the t of a ray.
const stepOf = ({ grid, sampling, coordinates }) => sampling.step * 2 * grid.half_width / grid.resolution / coordinates.stretch[2];
// Cameras that are not farther from the middle along an axis than this see all of the contracted world.
const FARTHEST = 8;

// The rays of a space: begin of the ray, and of the march. A ray in normalized device coordinates begins at the near plane. A ray of the
// contracted world has a parameter t whose even steps are about even in the box; no position moves faster than `fastest` with it.
const RAYS = {
  box: '',
  ndc: `if (d.z >= 0.0) return;
  vec3 entry = eye - (1.0 + eye.z) / d.z * d;
  from = vec3(ndc * entry.xy, -1.0) * axes;
  d = normalize(vec3(-ndc * (d.xy / d.z + entry.xy), 2.0)) * axes;
  d += vec3(lessThan(abs(d), vec3(1e-9))) * 1e-9;`,
  contracted: `float rate = abs(d.x), ahead = eye.x * sign(d.x);
  if (abs(d.y) > rate) { rate = abs(d.y); ahead = eye.y * sign(d.y); }
  if (abs(d.z) > rate) { rate = abs(d.z); ahead = eye.z * sign(d.z); }
  float bend = (1.0 - ahead) / rate, out_ = 1.0 + rate * (0.05 - bend);
  vec3 aside = abs(cross(eye, d));
  float fastest = 1.0 + 2.0 * max(aside.x, max(aside.y, aside.z));`,
};

// The shader for a grid: `slabs` textures' worth of four harmonics each lie one behind the other in one texture.
function shader(scene, slabs) {
  const { grid } = scene, nearest = grid.interpolation === 'nearest', count = grid.harmonics ? grid.harmonics.steps.length / 3 : 0;
  // No ray has more samples.
  const { step, samples } = scene.sampling, space = spaceOf(scene), bent = space === 'contracted';
  const longest = bent ? Math.sqrt(3) * (2 + FARTHEST) / stepOf(scene) : Math.sqrt(3) * grid.resolution / step;
  const turns = Math.ceil(step ? longest : samples) + 2;
  const lines = [];
  for (let s = 0; s < slabs; s++) {
    lines.push(`h = (textureLod(harmonics, (atlas + vec3(0.0, 0.0, float(${s}) * slab)) / harmonicSize, 0.0) * 255.0 - 128.0) * steps[${s}];`);
    for (let c = 0; c < 4 && 4 * s + c < 3 * count; c++)
      lines.push(`sum.${'rgb'[(4 * s + c) % 3]} += h.${'xyzw'[c]} * basis[${Math.floor((4 * s + c) / 3)}];`);
  }
  return `#version 300 es
precision highp float; precision highp int; precision highp sampler3D; precision highp usampler3D;
uniform usampler3D links;
uniform sampler3D voxels;
${slabs ? 'uniform usampler3D harmonicLinks; uniform sampler3D harmonics;' : ''}
uniform vec3 atlasSize, harmonicSize, eye, background;
uniform mat3 rotation;
uniform vec4 lens;              // focal lengths and principal point, pixels
uniform float height;           // of the picture, pixels
uniform float resolution, halfWidth, stepLength, slab, harmonicResolution, reduction, offset;
uniform vec3 axes;              // factors from the box to the grid
uniform vec2 ndc;
uniform vec2 points;            // number and largest t of the source paper's samples, or 0
${slabs ? `uniform vec4 steps[${slabs}];` : ''}
out vec4 color;

// Where voxel coordinates lie in their brick, and which one that is.
vec3 inside(vec3 u, float n, out ivec3 brick) {
  ${nearest ? 'vec3 cell = clamp(floor(u + 0.5), vec3(0.0), vec3(n - 1.0)); u = cell;'
            : 'u = clamp(u, vec3(0.0), vec3(n - 1.0)); vec3 cell = clamp(floor(u), vec3(0.0), vec3(max(n - 2.0, 0.0)));'}
  brick = ivec3(cell) >> 2;
  return u - vec3(4 * brick);
}
vec3 atlasPlace(uint link, vec3 local) {
  return vec3(link & 1023u, link >> 10 & 1023u, link >> 20 & 1023u) * 5.0 + local + 0.5;
}

void main() {
  vec2 pixel = vec2(gl_FragCoord.x, height - gl_FragCoord.y);
  vec3 along = rotation * vec3((pixel.x - lens.z) / lens.x, -(pixel.y - lens.w) / lens.y, -1.0);
  float stretch = length(along);
  vec3 d = along / stretch;
  d += vec3(lessThan(abs(d), vec3(1e-9))) * 1e-9;
  color = vec4(background, 1.0);
  vec3 from = eye;
  ${RAYS[space]}
  ${bent ? 'float near = out_ <= 1.0 ? 0.05 : bend + (1.0 - 1.0 / out_) / rate, far = bend + 1.0 / rate;' : `vec3 inverse = 1.0 / d;
  vec3 low = (-halfWidth - from) * inverse, high = (halfWidth - from) * inverse;
  vec3 first = min(low, high), last = max(low, high);
  float near = max(max(first.x, first.y), max(first.z, 0.0)), far = min(last.x, min(last.y, last.z));`}
  if (far <= near) return;
  ${count ? `float basis[${count}]; ${BASIS.slice(0, count).map((b, k) => `basis[${k}] = ${b};`).join(' ')}` : ''}
  float start = near, size = stepLength, half_ = 0.5, count = ceil((far - near) / stepLength);
  if (points.x > 0.0) {
    size = points.y * stretch / (points.x - 1.0);
    start = max(ceil(near / size), 0.0) * size;
    half_ = 0.0;
    count = min(floor(far / size), points.x - 1.0) - floor(start / size + 0.5) + 1.0;
  }
  float side = 2.0 * halfWidth / resolution, k = 0.0, light = 1.0;
  vec3 sum, seen = vec3(0.0), origin = (from + halfWidth) / side - 0.5, speed = d / side;
  vec4 h;
  for (int turn = 0; turn < ${turns}; turn++) {
    if (k >= count) break;
    float begin = start + k * size, length_ = size, t = begin;
    if (half_ > 0.0) { length_ = min(size, far - begin); t = begin + 0.5 * length_; }
    ${bent ? `float away = t <= bend ? t : bend + (1.0 / max(1.0 - rate * (t - bend), 1e-6) - 1.0) / rate;
    vec3 at = from + away * d, extent = abs(at);
    float m = max(1.0, max(extent.x, max(extent.y, extent.z)));
    vec3 u = (at * ((2.0 - 1.0 / m) / m) + halfWidth) / side - 0.5;` : 'vec3 u = origin + t * speed;'}
    ivec3 brick;
    vec3 local = inside(u, resolution, brick);
    uint link = texelFetch(links, brick.zyx, 0).r;
    if ((link & 0x80000000u) != 0u) {
      // Nothing nearer than so many bricks: on to where the ray leaves them.
      float free = float(link & 255u) - 1.0;
      ${bent ? `vec3 border = min(u - (vec3(brick) - free) * 4.0, (vec3(brick) + 1.0 + free) * 4.0 - u);
      vec3 leave = vec3(t + side / fastest * border);` : `vec3 border = (vec3(brick) + mix(vec3(-free), vec3(1.0 + free), greaterThan(d, vec3(0.0)))) * 4.0 ${nearest ? '- 0.5' : ''};
      vec3 leave = (border - origin) / speed;`}
      k = max(k + 1.0, ceil((min(leave.x, min(leave.y, leave.z)) - start) / size - half_));
      continue;
    }
    k += 1.0;
    vec4 voxel = textureLod(voxels, atlasPlace(link, local) / atlasSize, 0.0);
    if (voxel.a <= 0.0) continue;
    float alpha = 1.0 - exp(-voxel.a * length_ / side);
    sum = voxel.rgb + offset;
    ${slabs ? `ivec3 larger;
    vec3 inLarger = inside((u + 0.5) / reduction - 0.5, harmonicResolution, larger);
    uint harmonicLink = texelFetch(harmonicLinks, larger.zyx, 0).r;
    if ((harmonicLink & 0x80000000u) == 0u) {
      vec3 atlas = atlasPlace(harmonicLink, inLarger);
      ${lines.join('\n      ')}
    }` : ''}
    seen += light * alpha * ${grid.degree === null ? 'sum' : 'max(sum, 0.0)'};
    light *= 1.0 - alpha;
    if (light < 1e-3) break;
  }
  color = vec4(seen + light * background, 1.0);
}`;
}

// A renderer for a scene.
class Renderer {
  constructor(canvas, scene, bytes) {
    const gl = canvas.getContext('webgl2', { antialias: false, alpha: false, preserveDrawingBuffer: true });
    if (!gl) throw new Error('this browser has no WebGL2');
    Object.assign(this, { gl, canvas, scene, targets: new Map() });
    const { grid } = scene, most = gl.getParameter(gl.MAX_3D_TEXTURE_SIZE);
    const { atlas, texels, harmonics } = readGrid(grid, bytes, most);
    const filter = grid.interpolation === 'nearest' ? gl.NEAREST : gl.LINEAR;
    this.textures = {
      links: this.texture([atlas.side, atlas.side, atlas.side], gl.R32UI, gl.RED_INTEGER, gl.UNSIGNED_INT, atlas.links, gl.NEAREST),
      voxels: this.texture(atlas.size, gl.RGBA16F, gl.RGBA, gl.HALF_FLOAT, texels, filter),
    };
    const uniforms = this.uniforms = { atlasSize: atlas.size, resolution: grid.resolution, halfWidth: grid.half_width, offset: grid.offset,
      background: scene.background, axes: scene.coordinates.stretch };
    if (spaceOf(scene) === 'ndc') uniforms.ndc = [scene.coordinates.space.ndc.a, scene.coordinates.space.ndc.b];
    if (harmonics) {
      const { side, links, size: [w, h, d] } = harmonics.atlas, size = [w, h, harmonics.slabs * d];
      this.textures.harmonicLinks = this.texture([side, side, side], gl.R32UI, gl.RED_INTEGER, gl.UNSIGNED_INT, links, gl.NEAREST);
      this.textures.harmonics = this.texture(size, gl.RGBA8, gl.RGBA, gl.UNSIGNED_BYTE, harmonics.texels, filter);
      const { resolution, reduction, steps } = grid.harmonics;
      Object.assign(uniforms, { harmonicSize: size, slab: d, harmonicResolution: resolution, reduction,
        steps: Array.from({ length: 4 * harmonics.slabs }, (_, f) => steps[f] || 0) });
    }
    if (scene.sampling.step) uniforms.stepLength = stepOf(scene);
    else Object.assign(uniforms, { stepLength: 1, points: [scene.sampling.samples, scene.sampling.far] });
    this.link(shader(scene, harmonics ? harmonics.slabs : 0));
  }

  texture([w, h, d], format, kind, type, data, filter) {
    const { gl } = this, texture = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_3D, texture);
    gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
    gl.texImage3D(gl.TEXTURE_3D, 0, format, w, h, d, 0, kind, type, data);
    for (const side of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_3D, side, filter);
    for (const axis of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T, gl.TEXTURE_WRAP_R]) gl.texParameteri(gl.TEXTURE_3D, axis, gl.CLAMP_TO_EDGE);
    return texture;
  }

  link(fragment) {
    const { gl } = this, program = gl.createProgram();
    for (const [kind, source] of [[gl.VERTEX_SHADER, PASS], [gl.FRAGMENT_SHADER, fragment]]) {
      const part = gl.createShader(kind);
      gl.shaderSource(part, source);
      gl.compileShader(part);
      gl.attachShader(program, part);
    }
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS))
      throw new Error(gl.getAttachedShaders(program).map(s => gl.getShaderInfoLog(s)).join('') || gl.getProgramInfoLog(program));
    gl.useProgram(program);
    this.program = program;
    Object.entries(this.textures).forEach(([name, texture], unit) => {
      gl.activeTexture(gl.TEXTURE0 + unit);
      gl.bindTexture(gl.TEXTURE_3D, texture);
      gl.uniform1i(gl.getUniformLocation(program, name), unit);
    });
    for (const [name, value] of Object.entries(this.uniforms)) this.set(name, value);
  }

  set(name, value) {
    const { gl } = this, place = gl.getUniformLocation(this.program, name);
    if (name === 'steps') gl.uniform4fv(place, value);
    else if (name === 'rotation') gl.uniformMatrix3fv(place, false, value);
    else gl[`uniform${[value].flat().length}fv`](place, [value].flat());
  }

  // A place to draw to.
  target(name, width, height) {
    const { gl } = this, old = this.targets.get(name);
    if (old && old.width === width && old.height === height) return old;
    if (old) { gl.deleteFramebuffer(old.buffer); gl.deleteTexture(old.texture); }
    const buffer = gl.createFramebuffer(), texture = gl.createTexture();
    gl.activeTexture(gl.TEXTURE15);
    gl.bindTexture(gl.TEXTURE_2D, texture);
    gl.texStorage2D(gl.TEXTURE_2D, 1, gl.RGBA8, width, height);
    gl.bindFramebuffer(gl.FRAMEBUFFER, buffer);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, texture, 0);
    const made = { buffer, texture, width, height };
    this.targets.set(name, made);
    return made;
  }

  // Draws rows `from` to `to` of what a camera sees, and waits for them. Returns milliseconds.
  draw(camera, target, from = 0, to = target.height) {
    const { gl } = this, begin = performance.now(), scale = fitted(camera, target.width, target.height);
    gl.bindFramebuffer(gl.FRAMEBUFFER, target.buffer);
    gl.viewport(0, 0, target.width, target.height);
    gl.enable(gl.SCISSOR_TEST);
    gl.scissor(0, target.height - to, target.width, to - from);
    this.set('rotation', camera.rotation);
    this.set('eye', camera.eye);
    this.set('height', target.height);
    // The picture's middle stays the middle, whatever the shape of the target.
    const [left, above] = [0.5 * (target.width - scale * camera.width), 0.5 * (target.height - scale * camera.height)];
    this.set('lens', [camera.fx * scale, camera.fy * scale, camera.cx * scale + left, camera.cy * scale + above]);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
    gl.disable(gl.SCISSOR_TEST);
    gl.readPixels(0, target.height - to, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(4));
    return performance.now() - begin;
  }

  // Copies a target to another, or to the screen.
  copy(from, to) {
    const { gl, canvas } = this, [w, h] = to ? [to.width, to.height] : [canvas.width, canvas.height];
    gl.bindFramebuffer(gl.READ_FRAMEBUFFER, from.buffer);
    gl.bindFramebuffer(gl.DRAW_FRAMEBUFFER, to ? to.buffer : null);
    gl.blitFramebuffer(0, 0, from.width, from.height, 0, 0, w, h, gl.COLOR_BUFFER_BIT, gl.LINEAR);
  }

  // The picture that a camera sees, in its own size: RGBA, the upper left pixel first.
  picture(camera) {
    const { gl } = this, { width, height } = camera, target = this.target('picture', width, height), pixels = new Uint8ClampedArray(4 * width * height);
    const rows = Math.max(1, Math.floor(40000 / width));
    for (let y = 0; y < height; y += rows) this.draw(camera, target, y, Math.min(height, y + rows));
    gl.bindFramebuffer(gl.FRAMEBUFFER, target.buffer);
    gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, pixels);
    const upright = new Uint8ClampedArray(pixels.length);
    for (let y = 0; y < height; y++) upright.set(pixels.subarray(4 * width * y, 4 * width * (y + 1)), 4 * width * (height - 1 - y));
    return new ImageData(upright, width, height);
  }
}

// The viewer on the page. While the camera moves, the resolution is reduced to FRAME milliseconds per frame. At rest, the full resolution is drawn in bands of BAND milliseconds.
const FRAME = 60, BAND = 150;
class Viewer {
  constructor(figure, scene, bytes) {
    this.canvas = figure.querySelector('canvas');
    this.status = figure.querySelector('output');
    this.renderer = new Renderer(this.canvas, scene, bytes);
    // Textures are lost when the machine sleeps or is overloaded.
    this.canvas.addEventListener('webglcontextlost', e => { e.preventDefault(); this.status.textContent = 'The browser released the graphics memory; waiting to restore the view.'; });
    this.canvas.addEventListener('webglcontextrestored', () => {
      try {
        this.renderer = new Renderer(this.canvas, scene, bytes);
        this.moved();
      } catch (error) { this.status.textContent = `The view cannot be restored: ${error.message}`; }
    });
    this.camera = new Orbit(scene.views[0], scene.up);
    // Pixels of a frame and of a band, adapted to the measured times.
    this.pixels = { frame: 10000, band: 10000 };
    this.moving = { last: 0, scale: 1 };
    this.still = 0;
    this.listen(figure, scene);
    new ResizeObserver(() => this.moved()).observe(this.canvas);
    this.moved();
  }

  listen(figure, scene) {
    const { canvas, camera } = this;
    control(canvas, camera, () => this.moved());
    const select = figure.querySelector('select');
    select.append(...scene.views.map((view, i) => new Option(view.name, i)));
    const choose = () => { camera.from(scene.views[select.selectedIndex]); this.moved(); };
    select.addEventListener('change', choose);
    for (const [id, by] of [['previous', -1], ['next', 1]]) figure.querySelector(`#${id}`).addEventListener('click', () => {
      select.selectedIndex = (select.selectedIndex + by + scene.views.length) % scene.views.length;
      choose();
    });
    figure.querySelector('#save').addEventListener('click', () => this.save());
    const fill = figure.querySelector('#fill');
    fill.hidden = !document.fullscreenEnabled;
    fill.addEventListener('click', () => { canvas.requestFullscreen().then(() => canvas.focus(), error => { this.status.textContent = error.message; }); });
  }

  // Schedules a redraw after the camera has moved.
  moved() {
    this.still = -1;
    if (!this.waiting) { this.waiting = true; requestAnimationFrame(() => this.frame()); }
  }

  frame() {
    this.waiting = false;
    const { canvas, renderer, camera } = this, ratio = window.devicePixelRatio || 1;
    if (renderer.gl.isContextLost()) return;
    const width = Math.max(1, Math.round(canvas.clientWidth * ratio)), height = Math.max(1, Math.round(canvas.clientHeight * ratio));
    if (canvas.width !== width || canvas.height !== height) [canvas.width, canvas.height] = [width, height];
    if (this.still < 0) {
      const scale = Math.min(1, Math.sqrt(this.pixels.frame / (width * height)));
      const target = renderer.target('moving', Math.max(1, Math.round(scale * width)), Math.max(1, Math.round(scale * height)));
      const time = renderer.draw(camera, target);
      renderer.copy(target, null);
      this.learn('frame', time, FRAME, target.width * target.height);
      this.moving = { last: time, scale };
      [this.still, this.stillTime] = [0, 0];
      clearTimeout(this.rest);
      this.rest = setTimeout(() => this.still === 0 && requestAnimationFrame(() => this.frame()), 200);
    } else if (this.still < height) {
      const target = renderer.target('still', width, height);
      if (this.still === 0) renderer.copy(renderer.targets.get('moving'), target);
      const rows = Math.max(1, Math.floor(this.pixels.band / width));
      const to = Math.min(height, this.still + rows), time = renderer.draw(camera, target, this.still, to);
      this.learn('band', time, BAND, width * (to - this.still));
      this.stillTime += time;
      this.still = to;
      renderer.copy(target, null);
      if (to < height) requestAnimationFrame(() => this.frame());
    }
    const percent = Math.round(100 * this.moving.scale);
    this.status.textContent = `moving: ${this.moving.last.toFixed(0)} ms per frame at ${percent} % resolution; ` +
      (this.still < height ? 'refining' : `still: ${this.stillTime.toFixed(0)} ms for ${width} x ${height} pixels`);
  }

  // Adapts the number of pixels to the time they may take, with a lower limit.
  learn(what, time, goal, drawn) {
    const better = drawn * Math.max(0.5, Math.min(1.5, goal / time));
    this.pixels[what] = Math.max(better, 2500);
  }

  // Saves the current view as a PNG file, in the size of the photographs.
  save() {
    if (this.renderer.gl.isContextLost()) return;
    const picture = this.renderer.picture(this.camera), canvas = document.createElement('canvas'), link = document.createElement('a');
    [canvas.width, canvas.height] = [picture.width, picture.height];
    canvas.getContext('2d').putImageData(picture, 0, 0);
    link.href = canvas.toDataURL('image/png');
    link.download = 'view.png';
    link.click();
  }
}

// The code above can be tested without a page.
if (typeof document !== 'undefined') (async () => {
  const figure = document.getElementById('viewer');
  try {
    const scene = JSON.parse(document.getElementById('scene').textContent);
    if (!scene.views.length) throw new Error('there is no start view');
    window.viewer = new Viewer(figure, scene, await unpack(document.getElementById('grid').textContent.trim()));
  } catch (error) {
    figure.querySelector('output').textContent = `The viewer cannot be shown: ${error.message}`;
  }
})();
