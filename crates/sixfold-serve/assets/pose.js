// Poses as 4x4 matrices by rows, the pinhole camera, and a mesh as a photograph shows it.

export const identity = () => [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]];

export const product = (a, b) => a.map((row) => [0, 1, 2, 3].map((j) => row.reduce((sum, v, k) => sum + v * b[k][j], 0)));

export const apply = (m, p) => [0, 1, 2].map((i) => m[i][0] * p[0] + m[i][1] * p[1] + m[i][2] * p[2] + m[i][3]);

export function inverse(m) {
  const rows = [0, 1, 2].map((i) => [m[0][i], m[1][i], m[2][i]]);
  const t = [m[0][3], m[1][3], m[2][3]];
  return [...rows.map((r) => [...r, -(r[0] * t[0] + r[1] * t[1] + r[2] * t[2])]), [0, 0, 0, 1]];
}

/** A rotation by an angle about a camera axis (0, 1 or 2) through a point. */
export function rotationAbout(axis, angle, p) {
  const [c, s] = [Math.cos(angle), Math.sin(angle)];
  const m = identity();
  const [i, j] = [(axis + 1) % 3, (axis + 2) % 3];
  [m[i][i], m[i][j], m[j][i], m[j][j]] = [c, -s, s, c];
  const q = apply(m, p);
  [0, 1, 2].forEach((k) => { m[k][3] = p[k] - q[k]; });
  return m;
}

export function translation(x, y, z) {
  const m = identity();
  [m[0][3], m[1][3], m[2][3]] = [x, y, z];
  return m;
}

/** The pinhole camera of an image of another size; pixel centres lie at whole numbers. */
export function cameraOf(camera, width, height) {
  const [sx, sy] = [width / camera.width, height / camera.height];
  return {
    fx: camera.fx * sx, fy: camera.fy * sy, cx: (camera.cx + 0.5) * sx - 0.5, cy: (camera.cy + 0.5) * sy - 0.5, width, height,
  };
}

export const project = (camera, p) => [(camera.fx * p[0]) / p[2] + camera.cx, (camera.fy * p[1]) / p[2] + camera.cy];

/** The direction in which a pixel looks, z = 1. */
export const ray = (camera, [u, v]) => [(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, 1];

const minus = (a, b) => [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];

/** A mesh in the object's frame, from a geometry of viewer.js. */
export class Shape {
  constructor(geometry) {
    this.positions = geometry.attributes.position.array;
    this.faces = geometry.index.array;
  }

  vertex(i) {
    return [this.positions[3 * i], this.positions[3 * i + 1], this.positions[3 * i + 2]];
  }

  /** The faces that look at the camera, as a path in the image's pixels: filled, it is the silhouette. */
  silhouette(camera, cameraFromObject) {
    const count = this.positions.length / 3;
    const points = new Float32Array(2 * count);
    for (let i = 0; i < count; i++) {
      const p = apply(cameraFromObject, this.vertex(i));
      const pixel = p[2] > 0.01 ? project(camera, p) : [NaN, NaN];
      [points[2 * i], points[2 * i + 1]] = pixel;
    }
    const path = new Path2D();
    for (let f = 0; f < this.faces.length; f += 3) {
      const [a, b, c] = [0, 1, 2].map((k) => 2 * this.faces[f + k]);
      const area = (points[b] - points[a]) * (points[c + 1] - points[a + 1]) - (points[c] - points[a]) * (points[b + 1] - points[a + 1]);
      // y is down: faces that look at the camera run the other way round. NaN is no area.
      if (!(area < 0)) continue;
      path.moveTo(points[a], points[a + 1]);
      path.lineTo(points[b], points[b + 1]);
      path.lineTo(points[c], points[c + 1]);
      path.closePath();
    }
    return path;
  }

  /** Where a ray meets the mesh first, in the object's frame (Moeller and Trumbore 1997); null where it does not. */
  hit(origin, direction) {
    let nearest = Infinity;
    for (let f = 0; f < this.faces.length; f += 3) {
      const [a, b, c] = [0, 1, 2].map((k) => this.vertex(this.faces[f + k]));
      const [ab, ac] = [minus(b, a), minus(c, a)];
      const p = cross(direction, ac);
      const determinant = dot(ab, p);
      if (Math.abs(determinant) < 1e-14) continue;
      const t = minus(origin, a);
      const u = dot(t, p) / determinant;
      const q = cross(t, ab);
      const v = dot(direction, q) / determinant;
      const along = dot(ac, q) / determinant;
      if (u >= 0 && v >= 0 && u + v <= 1 && along > 1e-6) nearest = Math.min(nearest, along);
    }
    return nearest === Infinity ? null : origin.map((o, k) => o + nearest * direction[k]);
  }
}
