// Boxes and points -------------------------------------------------------------------------------

/** @param {number[]} box */
function rotation([, , , , , , roll, pitch, yaw]) {
  const [a, b, c, d, e, f] = [Math.cos(yaw), Math.sin(yaw), Math.cos(pitch), Math.sin(pitch), Math.cos(roll), Math.sin(roll)];
  return [[a * c, a * d * f - b * e, a * d * e + b * f], [b * c, b * d * f + a * e, b * d * e - a * f], [-d, c * f, c * e]];
}

function toFrame(point, box, R) {
  const d = [point[0] - box[0], point[1] - box[1], point[2] - box[2]];
  return [0, 1, 2].map(k => d[0] * R[0][k] + d[1] * R[1][k] + d[2] * R[2][k]);
}

function fromFrame(point, box, R) {
  return [0, 1, 2].map(k => box[k] + R[k][0] * point[0] + R[k][1] * point[1] + R[k][2] * point[2]);
}

function flipped(box) { const turned = box.slice(); turned[8] += Math.PI; return turned; }

function corners(box) {
  const R = rotation(box);
  return [-1, 1].flatMap(z => [[1, 1], [-1, 1], [-1, -1], [1, -1]].map(([x, y]) =>
    fromFrame([x * box[3] / 2, y * box[4] / 2, z * box[5] / 2], box, R)));
}

function numInside(points, box) {
  const R = rotation(box);
  return points.filter(point => toFrame(point, box, R).every((v, k) => Math.abs(v) <= box[3 + k] / 2)).length;
}

// The area of a polygon whose corners go around once.
function area(polygon) {
  return Math.abs(polygon.reduce((sum, [x, y], k) => {
    const [nextX, nextY] = polygon[(k + 1) % polygon.length];
    return sum + (x * nextY - nextX * y) / 2;
  }, 0));
}

// The part of a polygon on the left of the line from a to b (Sutherland and Hodgman).
function leftOf(polygon, a, b) {
  const side = p => (b[0] - a[0]) * (p[1] - a[1]) - (b[1] - a[1]) * (p[0] - a[0]);
  return polygon.flatMap((p, k) => {
    const next = polygon[(k + 1) % polygon.length];
    const [here, there] = [side(p), side(next)];
    const kept = here >= 0 ? [p] : [];
    if (here * there < 0) kept.push([0, 1].map(i => p[i] + here / (here - there) * (next[i] - p[i])));
    return kept;
  });
}

// 3D IoU of two boxes, their roll and pitch left out.
function overlap(first, second) {
  const ground = box => {
    const [cos, sin] = [Math.cos(box[8]), Math.sin(box[8])];
    return [[1, 1], [-1, 1], [-1, -1], [1, -1]].map(([x, y]) => [x * box[3] / 2, y * box[4] / 2])
      .map(([x, y]) => [box[0] - first[0] + cos * x - sin * y, box[1] - first[1] + sin * x + cos * y]);
  };
  const clip = ground(second);
  const common = clip.reduce((polygon, a, k) => leftOf(polygon, a, clip[(k + 1) % 4]), ground(first));
  const height = Math.min(first[2] + first[5] / 2, second[2] + second[5] / 2) - Math.max(first[2] - first[5] / 2, second[2] - second[5] / 2);
  const both = area(common) * Math.max(0, height);
  return both / (first[3] * first[4] * first[5] + second[3] * second[4] * second[5] - both);
}
