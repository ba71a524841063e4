// What the shader of viewer.js does, in numbers: this file comes after it. One JSON object on stdin, one on stdout.
const fromHalf = h => {
  const sign = h & 0x8000 ? -1 : 1, exponent = h >> 10 & 31, fraction = h & 0x3ff;
  return sign * (exponent ? (1 + fraction / 1024) * 2 ** (exponent - 15) : fraction * 2 ** -24);
};

// Where voxel coordinates lie in their brick, and which one that is: `inside` of the shader.
function inside(u, n, nearest) {
  u = u.map(x => (nearest ? Math.floor(x + 0.5) : x)).map(x => Math.min(Math.max(x, 0), n - 1));
  const cell = nearest ? u : u.map(x => Math.min(Math.max(Math.floor(x), 0), Math.max(n - 2, 0)));
  const brick = cell.map(x => x >> 2);
  return { brick, local: u.map((x, a) => x - 4 * brick[a]) };
}
const linkOf = ({ links, side }, [x, y, z]) => links[(x * side + y) * side + z];

// What the texture unit answers: `read` is asked for the numbers of up to eight texels, in a slab.
function interpolated({ size }, link, local, read) {
  const corner = local.map((x, a) => CORNERS * (link >> 10 * a & 1023) + Math.floor(x)), part = local.map(x => x - Math.floor(x));
  const sum = [0, 0, 0, 0];
  for (let c = 0; c < 8; c++) {
    const step = [c & 1, c >> 1 & 1, c >> 2], weight = step.reduce((w, s, a) => w * (s ? part[a] : 1 - part[a]), 1);
    if (weight === 0) continue;
    const [x, y, z] = corner.map((k, a) => k + step[a]);
    read((z * size[1] + y) * size[0] + x).forEach((v, i) => { sum[i] += weight * v; });
  }
  return sum;
}

const basisAt = (count, [x, y, z]) => BASIS.slice(0, count).map(text => Function('d', `return ${text}`)({ x, y, z }));

class Numbers {
  constructor(scene, bytes) {
    const { grid } = scene;
    Object.assign(this, { scene, grid, nearest: grid.interpolation === 'nearest' }, readGrid(grid, bytes, 2048));
    this.side = 2 * grid.half_width / grid.resolution;
  }

  voxels(point) { return point.map(x => (x + this.grid.half_width) / this.side - 0.5); }

  // Mean color and density times the side of a voxel; or how many bricks away the next one is.
  at(u) {
    const { brick, local } = inside(u, this.grid.resolution, this.nearest), link = linkOf(this.atlas, brick);
    if (link & DISTANCE) return { brick, free: (link & 255) - 1 };
    return { voxel: interpolated(this.atlas, link, local, t => [...this.texels.subarray(4 * t, 4 * t + 4)].map(fromHalf)) };
  }

  density(point) {
    const { voxel } = this.at(this.voxels(point));
    return voxel ? Math.max(0, voxel[3]) / this.side : 0;
  }

  color(mean, u, basis) {
    const { grid } = this, sum = mean.map(c => c + grid.offset);
    if (this.harmonics) {
      const { atlas, texels, slabs } = this.harmonics, { resolution, reduction, steps } = grid.harmonics;
      const { brick, local } = inside(u.map(x => (x + 0.5) / reduction - 0.5), resolution, this.nearest), link = linkOf(atlas, brick);
      const slab = atlas.size[0] * atlas.size[1] * atlas.size[2];
      for (let s = 0; s < slabs && !(link & DISTANCE); s++)
        interpolated(atlas, link, local, t => [...texels.subarray(4 * (s * slab + t), 4 * (s * slab + t) + 4)]).forEach((byte, c) => {
          const f = 4 * s + c;
          if (f < steps.length) sum[f % 3] += (byte - 128) * steps[f] * basis[Math.floor(f / 3)];
        });
    }
    return grid.degree === null ? sum : sum.map(c => Math.max(c, 0));
  }

  // The ray of a space: its begin and direction in the grid, where the march begins and ends, and the position at t.
  march(eye, along) {
    const { grid, scene } = this, axes = scene.coordinates.stretch, length = Math.hypot(...along);
    const steady = d => d.map(x => (Math.abs(x) < 1e-9 ? x + 1e-9 : x));
    let d = steady(along.map(x => x / length)), from = eye;
    if (spaceOf(scene) === 'contracted') {
      const b = [0, 1, 2].reduce((b, a) => (Math.abs(d[a]) > Math.abs(d[b]) ? a : b), 0), rate = Math.abs(d[b]);
      const bend = (1 - eye[b] * Math.sign(d[b])) / rate, out = 1 + rate * (0.05 - bend);
      const cross = [0, 1, 2].map(a => Math.abs(eye[(a + 1) % 3] * d[(a + 2) % 3] - eye[(a + 2) % 3] * d[(a + 1) % 3]));
      return {
        d, near: out <= 1 ? 0.05 : bend + (1 - 1 / out) / rate, far: bend + 1 / rate, fastest: 1 + 2 * Math.max(...cross),
        at: t => {
          const away = t <= bend ? t : bend + (1 / Math.max(1 - rate * (t - bend), 1e-6) - 1) / rate, p = d.map((x, a) => eye[a] + away * x);
          const m = Math.max(1, ...p.map(Math.abs));
          return p.map(x => x * (2 - 1 / m) / m);
        },
      };
    }
    if (spaceOf(scene) === 'ndc') {
      if (d[2] >= 0) return { d, near: 0, far: 0 };
      const { a, b } = scene.coordinates.space.ndc, entry = d.map((x, k) => eye[k] - (1 + eye[2]) / d[2] * x);
      from = [a * entry[0], b * entry[1], -1].map((x, k) => x * axes[k]);
      const to = [-a * (d[0] / d[2] + entry[0]), -b * (d[1] / d[2] + entry[1]), 2], size = Math.hypot(...to);
      d = steady(to.map((x, k) => x / size * axes[k]));
    }
    const bounds = d.map((x, a) => [(-grid.half_width - from[a]) / x, (grid.half_width - from[a]) / x]);
    const near = Math.max(0, ...bounds.map(b => Math.min(...b))), far = Math.min(...bounds.map(b => Math.max(...b)));
    return { d, near, far, at: t => from.map((p, a) => p + t * d[a]) };
  }

  // `main` of the shader.
  ray(eye, along) {
    const { grid, side } = this, stretch = Math.hypot(...along), { d, near, far, at, fastest } = this.march(eye, along);
    const { step, samples, far: last } = this.scene.sampling;
    let light = 1, start = near, size = stepOf(this.scene), middle = 0.5, count = Math.ceil((far - near) / size);
    if (!step) {
      size = last * stretch / (samples - 1);
      start = Math.max(Math.ceil(near / size), 0) * size;
      middle = 0;
      count = Math.min(Math.floor(far / size), samples - 1) - Math.floor(start / size + 0.5) + 1;
    }
    const seen = [0, 0, 0], basis = this.harmonics ? basisAt(grid.harmonics.steps.length / 3, d) : [];
    for (let k = 0; far > near && k < count && light >= 1e-3;) {
      const begin = start + k * size, length = middle ? Math.min(size, far - begin) : size, t = begin + middle * length;
      const u = this.voxels(at(t)), { voxel, brick, free } = this.at(u);
      if (!voxel) {
        this.skipped = (this.skipped || 0) + 1;
        const border = [1, -1].map(sign => brick.map((b, a) => ((b + (sign > 0 ? 1 + free : -free)) * 4 - (this.nearest ? 0.5 : 0) - u[a]) * sign));
        const leave = fastest ? border.flat().map(x => x / fastest) : border[0].map((x, a) => (d[a] > 0 ? x : border[1][a]) / Math.abs(d[a]));
        k = Math.max(k + 1, Math.ceil((t + side * Math.min(...leave) - start) / size - middle));
        continue;
      }
      k++;
      if (voxel[3] <= 0) continue;
      const alpha = 1 - Math.exp(-voxel[3] * length / side), rgb = this.color(voxel.slice(0, 3), u, basis);
      rgb.forEach((c, i) => { seen[i] += light * alpha * c; });
      light *= 1 - alpha;
    }
    return seen.map((c, i) => c + light * this.scene.background[i]);
  }

  // The pixels of a view, row by row.
  picture({ pose, width, height, fx, fy, cx, cy }) {
    const pixels = [];
    for (let y = 0; y < height; y++) for (let x = 0; x < width; x++) {
      const lens = [(x + 0.5 - cx) / fx, -(y + 0.5 - cy) / fy, -1];
      pixels.push(this.ray(pose.slice(9), [0, 1, 2].map(a => lens.reduce((sum, l, k) => sum + l * pose[3 * k + a], 0))));
    }
    return pixels;
  }
}

(async () => {
  const asked = JSON.parse(require('fs').readFileSync(0, 'utf8')), numbers = new Numbers(asked.scene, await unpack(asked.bytes));
  const pictures = asked.scene.views.map(view => numbers.picture(view));
  console.log(JSON.stringify({
    densities: asked.points.map(point => numbers.density(point)),
    bases: asked.directions.map(direction => basisAt(15, direction)),
    pictures,
    skipped: numbers.skipped || 0,
    halves: asked.halves.map(half),
  }));
})();
