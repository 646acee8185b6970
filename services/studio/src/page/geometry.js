// Vectors, rotations and cameras. World to camera: x_cam = R x + t, R by rows; z points forward, y down.

/** @typedef {import("./api.js").Camera} Camera */
/** @typedef {import("./api.js").View} View */
/** @typedef {number[]} Vector */

/** @param {Vector} a @param {Vector} b */
export const add = (a, b) => a.map((x, k) => x + b[k]);
/** @param {Vector} a @param {Vector} b */
export const subtract = (a, b) => a.map((x, k) => x - b[k]);
/** @param {Vector} a @param {number} s */
export const scale = (a, s) => a.map(x => x * s);
/** @param {Vector} a @param {Vector} b */
export const dot = (a, b) => a.reduce((sum, x, k) => sum + x * b[k], 0);
/** @param {Vector} a */
export const length = a => Math.sqrt(dot(a, a));
/** @param {Vector} a */
export const unit = a => scale(a, 1 / (length(a) || 1));
/** @param {Vector} a @param {Vector} b */
export const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
/** @param {number[]} R @param {Vector} v */
export const rotate = (R, v) => [dot(R.slice(0, 3), v), dot(R.slice(3, 6), v), dot(R.slice(6, 9), v)];
/** @param {number[]} R */
export const transposed = R => [R[0], R[3], R[6], R[1], R[4], R[7], R[2], R[5], R[8]];

/** The centre of a view's camera. @param {{rotation: number[], translation: Vector}} view */
export const centreOf = view => scale(rotate(transposed(view.rotation), view.translation), -1);

/**
 * Turns a vector around an axis.
 * @param {Vector} v @param {Vector} axis @param {number} angle
 */
export function turned(v, axis, angle) {
  const c = Math.cos(angle), s = Math.sin(angle);
  return add(add(scale(v, c), scale(cross(axis, v), s)), scale(axis, dot(axis, v) * (1 - c)));
}

/** The pose of a camera at `eye` with these directions. @param {Vector} eye @param {Vector} forward @param {Vector} down */
export function pose(eye, forward, down) {
  const z = unit(forward), x = unit(cross(down, z)), y = cross(z, x), rotation = [...x, ...y, ...z];
  return { rotation, translation: scale(rotate(rotation, eye), -1) };
}

/**
 * A photo's camera in a frame of another size: the whole photo is seen, its principal point stays where it is in it.
 * @param {Camera} camera @param {number} width @param {number} height @returns {Camera}
 */
export function fitted(camera, width, height) {
  const s = Math.min(width / camera.width, height / camera.height);
  return {
    width, height, fx: s * camera.fx, fy: s * camera.fy,
    cx: s * camera.cx + (width - s * camera.width) / 2, cy: s * camera.cy + (height - s * camera.height) / 2,
  };
}

/** @param {Camera} camera @param {number} s @returns {Camera} */
export function scaled(camera, s) {
  const width = Math.max(1, Math.round(camera.width * s)), height = Math.max(1, Math.round(camera.height * s));
  const [sx, sy] = [width / camera.width, height / camera.height];
  return { width, height, fx: camera.fx * sx, fy: camera.fy * sy, cx: camera.cx * sx, cy: camera.cy * sy };
}

/** Where a view shows a point; null behind it. @param {View} view @param {Vector} point */
export function project(view, point) {
  const p = add(rotate(view.rotation, point), view.translation);
  if (p[2] <= 1e-6) return null;
  return [view.camera.fx * p[0] / p[2] + view.camera.cx, view.camera.fy * p[1] / p[2] + view.camera.cy, p[2]];
}
