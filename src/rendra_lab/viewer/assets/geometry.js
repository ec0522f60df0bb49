// From the payload's text to typed arrays, and what is computed from them.

const ARRAYS = { f32: Float32Array, u32: Uint32Array, u16: Uint16Array, u8: Uint8Array };

function decoded(packed) {
  const text = atob(packed.data);
  const bytes = new Uint8Array(text.length);
  for (let i = 0; i < bytes.length; i++) bytes[i] = text.charCodeAt(i);
  return new ARRAYS[packed.type](bytes.buffer);
}

// Positions relative to `origin`: far from zero, single precision would shake.
function decodedPositions(packed, origin) {
  const counts = decoded(packed);
  const low = packed.low || [0, 0, 0];
  const step = packed.step || [1, 1, 1];
  const points = new Float32Array(counts.length);
  for (let i = 0; i < counts.length; i++) {
    const axis = i % 3;
    points[i] = low[axis] - origin[axis] + step[axis] * counts[i];
  }
  return points;
}

// Directions from the octahedron that was unfolded onto a square; (0, 0) is none.
function decodedNormals(packed) {
  const square = decoded(packed);
  const normals = new Float32Array(square.length / 2 * 3);
  for (let i = 0; i < square.length / 2; i++) {
    if (square[2 * i] === 0 && square[2 * i + 1] === 0) continue;
    let x = (square[2 * i] - 32768) / 32767;
    let y = (square[2 * i + 1] - 32768) / 32767;
    const z = 1 - Math.abs(x) - Math.abs(y);
    if (z < 0) {
      const folded = (1 - Math.abs(y)) * (x < 0 ? -1 : 1);
      y = (1 - Math.abs(x)) * (y < 0 ? -1 : 1);
      x = folded;
    }
    const n = Math.sqrt(x * x + y * y + z * z);
    normals[3 * i] = x / n;
    normals[3 * i + 1] = y / n;
    normals[3 * i + 2] = z / n;
  }
  return normals;
}

// For every vertex the first one at the same place: seams of textures are no edges of the surface.
function firstAtPlace(points) {
  const count = points.length / 3;
  const bits = new Uint32Array(points.buffer, points.byteOffset, points.length);
  let capacity = 16;
  while (capacity < 2 * count) capacity *= 2;
  const table = new Int32Array(capacity).fill(-1);
  const first = new Uint32Array(count);
  for (let i = 0; i < count; i++) {
    const x = points[3 * i], y = points[3 * i + 1], z = points[3 * i + 2];
    let hash = Math.imul(bits[3 * i], 0x9e3779b1);
    hash = Math.imul(hash ^ (hash >>> 15) ^ bits[3 * i + 1], 0x85ebca6b);
    hash = Math.imul(hash ^ (hash >>> 13) ^ bits[3 * i + 2], 0xc2b2ae35);
    let slot = (hash ^ (hash >>> 16)) & (capacity - 1);
    for (;;) {
      const other = table[slot];
      if (other < 0) {
        table[slot] = i;
        first[i] = i;
        break;
      }
      if (points[3 * other] === x && points[3 * other + 1] === y && points[3 * other + 2] === z) {
        first[i] = other;
        break;
      }
      slot = (slot + 1) & (capacity - 1);
    }
  }
  return first;
}

// Normals at the vertices, the mean of the faces around weighted by their areas; `bend` is the mean cosine between
// the normals of faces and of their corners: small for boxes, which look better flat.
function smoothNormals(points, faces) {
  const first = firstAtPlace(points);
  const sums = new Float32Array(points.length);
  for (let f = 0; f < faces.length; f += 3) {
    const n = faceNormal(points, faces, f);
    for (let k = 0; k < 3; k++) {
      const v = 3 * first[faces[f + k]];
      sums[v] += n[0];
      sums[v + 1] += n[1];
      sums[v + 2] += n[2];
    }
  }
  for (let v = 0; v < sums.length; v += 3) {
    const n = Math.sqrt(sums[v] * sums[v] + sums[v + 1] * sums[v + 1] + sums[v + 2] * sums[v + 2]) || 1;
    sums[v] /= n;
    sums[v + 1] /= n;
    sums[v + 2] /= n;
  }
  const normals = new Float32Array(points.length);
  for (let v = 0; v < first.length; v++) {
    for (let axis = 0; axis < 3; axis++) normals[3 * v + axis] = sums[3 * first[v] + axis];
  }
  return { normals: normals, bend: meanBend(points, faces, normals) };
}

function faceNormal(points, faces, f) {
  const a = 3 * faces[f], b = 3 * faces[f + 1], c = 3 * faces[f + 2];
  const ux = points[b] - points[a], uy = points[b + 1] - points[a + 1], uz = points[b + 2] - points[a + 2];
  const vx = points[c] - points[a], vy = points[c + 1] - points[a + 1], vz = points[c + 2] - points[a + 2];
  return [uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx];
}

function meanBend(points, faces, normals) {
  let sum = 0, areas = 0;
  for (let f = 0; f < faces.length; f += 3) {
    const n = faceNormal(points, faces, f);
    areas += 3 * size(n);
    for (let k = 0; k < 3; k++) {
      const v = 3 * faces[f + k];
      sum += n[0] * normals[v] + n[1] * normals[v + 1] + n[2] * normals[v + 2];
    }
  }
  return areas > 0 ? sum / areas : 1;
}

// The three sides of every face as pairs of vertices.
function sidesOfFaces(faces) {
  const sides = new Uint32Array(2 * faces.length);
  for (let f = 0; f < faces.length; f += 3) {
    for (let k = 0; k < 3; k++) {
      sides[2 * (f + k)] = faces[f + k];
      sides[2 * (f + k) + 1] = faces[f + (k + 1) % 3];
    }
  }
  return sides;
}

// The smallest box around boxes [low, high]; null around none.
function boxAround(boxes) {
  if (!boxes.length) return null;
  const axes = [0, 1, 2];
  return [
    axes.map((axis) => Math.min(...boxes.map((box) => box[0][axis]))),
    axes.map((axis) => Math.max(...boxes.map((box) => box[1][axis]))),
  ];
}

// The volume that two boxes share, as a part of that of both together; sides of no length count as a little.
function sharedPart(a, b) {
  const low = Math.max(...subtract(a[1], a[0]), ...subtract(b[1], b[0])) * 1e-3;
  const volume = (from, to) => [0, 1, 2].reduce((product, i) => product * Math.max(0, to[i] - from[i] + low), 1);
  const shared = volume([0, 1, 2].map((i) => Math.max(a[0][i], b[0][i])), [0, 1, 2].map((i) => Math.min(a[1][i], b[1][i])));
  return shared / (volume(a[0], a[1]) + volume(b[0], b[1]) - shared || 1);
}

// 1, 2 or 5 times a power of ten, not below x.
function roundStep(x) {
  const power = Math.pow(10, Math.floor(Math.log10(x)));
  return power * [1, 2, 5, 10].find((factor) => factor * power >= x * 0.999);
}
