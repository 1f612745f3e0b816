// Trajectories as lines that are as wide on every screen, with marks at start, end and the present time.
import * as THREE from "../vendor/three/three.module.min.js";
import { LineMaterial } from "../vendor/three/LineMaterial.js";
import { LineSegments2 } from "../vendor/three/LineSegments2.js";
import { LineSegmentsGeometry } from "../vendor/three/LineSegmentsGeometry.js";
import { isDark, parts, rangeOf, scaleOf, shareOf } from "./colours.js";

const WIDTH_PX = 2.5;
const TRUTH_WIDTH_PX = 1.6;
const DASHES = 150;
/** What paths can be coloured by: the values, and the words for the scale. */
export const BY = {
  error: { values: (path) => path.errors_m, words: "position error [m]" },
  speed: { values: (path) => path.speeds_mps, words: "speed [m/s]" },
  time: { values: (path) => path.times_s, words: "time [s]" },
};

/** A mark as a small picture: a disc, a ring or a square. */
function picture(kind) {
  const canvas = document.createElement("canvas");
  canvas.width = canvas.height = 64;
  const pen = canvas.getContext("2d");
  pen.fillStyle = pen.strokeStyle = "#fff";
  pen.lineWidth = 12;
  pen.beginPath();
  if (kind === "square") pen.rect(12, 12, 40, 40);
  else pen.arc(32, 32, kind === "ring" ? 24 : 29, 0, 2 * Math.PI);
  if (kind === "ring") pen.stroke();
  else pen.fill();
  return new THREE.CanvasTexture(canvas);
}

function mark(kind, size) {
  const geometry = new THREE.BufferGeometry();
  geometry.setAttribute("position", new THREE.BufferAttribute(new Float32Array(3), 3));
  const look = { size: size * Math.min(2, window.devicePixelRatio || 1), sizeAttenuation: false, map: picture(kind) };
  const points = new THREE.Points(geometry, new THREE.PointsMaterial({ ...look, transparent: true, alphaTest: 0.4, depthTest: false }));
  points.frustumCulled = false;
  points.renderOrder = 2;
  return points;
}

export class PathView {
  constructor(path, extent) {
    this.path = path;
    this.group = new THREE.Group();
    const { positions_m: at, pieces } = path;
    this.segments = [];
    for (let place = 0; place + 1 < pieces.length; place++) {
      if (pieces[place] === pieces[place + 1]) this.segments.push(place);
    }
    if (this.segments.length) {
      const ends = new Float32Array(this.segments.length * 6);
      this.segments.forEach((place, number) => ends.set(at.subarray(3 * place, 3 * place + 6), 6 * number));
      const geometry = new LineSegmentsGeometry().setPositions(ends);
      const dash = { dashed: path.truth, dashSize: extent / DASHES, gapSize: extent / DASHES };
      const width = path.truth ? TRUTH_WIDTH_PX : WIDTH_PX;
      this.line = new LineSegments2(geometry, new LineMaterial({ linewidth: width, vertexColors: true, ...dash }));
      this.line.computeLineDistances();
      this.line.frustumCulled = false;
      this.group.add(this.line);
    }
    // That of the ground truth is larger and below the others, so that both are seen where they coincide.
    this.now = mark("disc", path.truth ? 18 : 12);
    this.now.renderOrder = path.truth ? 2 : 3;
    this.start = mark("ring", 11);
    this.end = mark("square", 9);
    this.place(this.start, new THREE.Vector3().fromArray(at, 0));
    this.place(this.end, new THREE.Vector3().fromArray(at, at.length - 3));
    this.group.add(this.start, this.end, this.now);
  }

  get colour() {
    return isDark() ? this.path.dark : this.path.colour;
  }

  place(points, position) {
    points.geometry.attributes.position.setXYZ(0, position.x, position.y, position.z);
    points.geometry.attributes.position.needsUpdate = true;
  }

  /** Colour by what ``by`` names, over a range; in the path's own colour without a range or without values. */
  paint(by, range) {
    const values = range ? BY[by].values(this.path) : null;
    const scale = values && scaleOf("plasma");
    const own = parts(this.colour);
    const colourAt = (place) => scale ? scale(shareOf(values[place], range)) : own;
    const colours = new Float32Array(this.segments.length * 6);
    const colour = new THREE.Color();
    this.segments.forEach((place, number) => {
      for (const end of [0, 1]) colour.setRGB(...colourAt(place + end), THREE.SRGBColorSpace).toArray(colours, 6 * number + 3 * end);
    });
    if (this.line) this.line.geometry.setColors(colours);
    for (const points of [this.now, this.start, this.end]) points.material.color.setRGB(...own, THREE.SRGBColorSpace);
  }

  /** Where the path is at a time; null before it, after it, and in a gap. */
  at(time_s) {
    const { times_s: times, positions_m: at, pieces } = this.path;
    if (!(time_s >= times[0] - 1e-3 && time_s <= times[times.length - 1] + 1e-3)) return null;
    let low = 0;
    let high = times.length - 1;
    while (high - low > 1) {
      const middle = (low + high) >> 1;
      if (times[middle] <= time_s) low = middle;
      else high = middle;
    }
    if (pieces[low] !== pieces[high]) return null;
    const share = Math.min(1, Math.max(0, shareOf(time_s, [times[low], times[high]])));
    const first = new THREE.Vector3().fromArray(at, 3 * low);
    return first.lerp(new THREE.Vector3().fromArray(at, 3 * high), share);
  }

  /** Move the mark of the present time; returns where it is. */
  move(time_s) {
    const position = this.at(time_s);
    this.now.visible = position !== null;
    if (position) this.place(this.now, position);
    return position;
  }
}

/** The range of what paths are coloured by; null for their own colours. */
export function rangeOfPaths(by, paths) {
  const lists = by in BY ? paths.map(BY[by].values).filter(Boolean) : [];
  return rangeOf(lists);
}
