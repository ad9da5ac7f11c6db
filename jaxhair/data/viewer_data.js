// The recording out of the page: the reverse of jaxhair/viewer_data.py.

const TYPES = { uint8: Uint8Array, uint32: Uint32Array, float32: Float32Array };

// The header with, in addition, `arrays` by name, `positions` (frames, strands, points, 3; in
// steps of the box) and `levels` of each field.
async function readRecording() {
  const header = JSON.parse(document.getElementById("header").textContent);
  const text = atob(document.getElementById("data").textContent);
  const packed = Uint8Array.from(text, (c) => c.charCodeAt(0));
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate"));
  const bytes = await new Response(stream).arrayBuffer();
  const arrays = {};
  for (const { name, type, shape, offset } of header.arrays) {
    arrays[name] = new TYPES[type](bytes, offset, shape.reduce((a, b) => a * b, 1));
  }
  const frames = header.times.length;
  const low = arrays.positions_low, high = arrays.positions_high;
  const positions = new Uint16Array(low.length);
  for (let i = 0; i < low.length; i++) positions[i] = low[i] | (high[i] << 8);
  addUp(positions, frames);
  const levels = {};
  for (const name of Object.keys(header.fields)) levels[name] = addUp(arrays[name], frames);
  return { ...header, arrays, positions, levels };
}

// Each frame is what is added to the one before; the array's type does the modulo.
function addUp(array, frames) {
  const size = array.length / frames;
  for (let i = size; i < array.length; i++) array[i] += array[i - size];
  return array;
}

// Points of all hairs of a frame, 4 numbers each: x y z and the level (0 to 1) of a field, as
// `Interpolation.hairs` and with its names.
function growHairs(of, frame, field, result) {
  const { strands, points, low, step, reach } = of;
  const counts = of.arrays.counts, rows = of.arrays.hairs;
  const start = frame * strands * points * 3;
  const guides = new Float32Array(strands * points * 3);
  for (let i = 0; i < guides.length; i++) {
    guides[i] = low[i % 3] + step[i % 3] * of.positions[start + i];
  }
  const about = field && of.fields[field];
  const columns = about ? (about.edges ? points - 1 : Math.max(points - 2, 1)) : 0;
  const levels = about && of.levels[field];
  for (let hair = 0; hair < rows.length / 11; hair++) {
    const row = rows.subarray(hair * 11, hair * 11 + 11);
    const guide = row[0], count = counts[guide];
    for (let i = 0; i < points; i++) {
      const place = Math.min(i, count - 1), own = (guide * points + place) * 3;
      const along = place / Math.max(count - 1, 1);
      const root = Math.min(0.35 + 2 * along, 1);
      let x = row[5] * root, y = row[6] * root, z = row[7] * root;
      for (let k = 0; k < 2; k++) {
        const weight = row[3 + k], other = row[1 + k];
        if (weight === 0) continue;
        // Past the tip of the shorter one, the hairs run on side by side.
        const upto = Math.min(place, counts[other] - 1);
        const a = (other * points + upto) * 3, b = (guide * points + upto) * 3;
        const dx = guides[a] - guides[b], dy = guides[a + 1] - guides[b + 1];
        const dz = guides[a + 2] - guides[b + 2];
        const pull = weight / Math.sqrt(1 + (dx * dx + dy * dy + dz * dz) / (reach * reach));
        x += pull * dx;
        y += pull * dy;
        z += pull * dz;
      }
      const kept = 1 - row[8] * along ** 1.5, to = (hair * points + i) * 4;
      result[to] = guides[own] + kept * x;
      result[to + 1] = guides[own + 1] + kept * y;
      result[to + 2] = guides[own + 2] + kept * z;
      if (!about) continue;
      const last = about.edges ? count - 2 : Math.max(count - 3, 0);
      const column = Math.min(Math.max(about.edges ? i : i - 1, 0), last);
      result[to + 3] = levels[(frame * strands + guide) * columns + column] / 255;
    }
  }
}

// Vertices with normals, 6 numbers each, of a shape; its normals vary smoothly.
function smoothShape(vertices, triangles) {
  const normals = new Float32Array(vertices.length);
  for (let i = 0; i < triangles.length; i += 3) {
    const [a, b, c] = [0, 1, 2].map((k) => vertices.subarray(3 * triangles[i + k]).slice(0, 3));
    const normal = cross(minus(b, a), minus(c, a)); // as long as the triangle is large
    for (let k = 0; k < 9; k++) normals[3 * triangles[i + Math.floor(k / 3)] + k % 3] += normal[k % 3];
  }
  const result = new Float32Array(2 * vertices.length);
  for (let i = 0; i < vertices.length / 3; i++) {
    result.set(vertices.subarray(3 * i, 3 * i + 3), 6 * i);
    result.set(unit(normals.subarray(3 * i, 3 * i + 3)), 6 * i + 3);
  }
  return result;
}

const minus = (a, b) => [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross = (a, b) => [
  a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0],
];
const unit = (a) => Array.from(a, (x) => x / (Math.hypot(...a) || 1));
