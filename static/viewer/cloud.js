// The map as points, coloured by height, intensity or the distance to the reference map.
import * as THREE from "../vendor/three/three.module.min.js";
import { rangeOf, scaleOf, shareOf } from "./colours.js";

const POINT_PX = 1.7;
/** What points can be coloured by, in words for the scale. */
export const BY = {
  height: "height [m]",
  intensity: "intensity",
  error: "distance to the reference map [m]",
};

export class CloudView {
  constructor(points, centre_m, up) {
    this.points = points;
    const geometry = new THREE.BufferGeometry();
    geometry.setAttribute("position", new THREE.BufferAttribute(points.positions_m, 3));
    const size = POINT_PX * Math.min(2, window.devicePixelRatio || 1);
    this.object = new THREE.Points(geometry, new THREE.PointsMaterial({ size, sizeAttenuation: false, vertexColors: true }));
    this.object.position.set(...points.origin_m.map((value, axis) => value - centre_m[axis]));
    this.object.frustumCulled = false;
    const heights = new Float32Array(points.points);
    const { positions_m: at, origin_m: origin } = points;
    const zero = origin.reduce((sum, value, axis) => sum + value * up[axis], 0);
    for (let place = 0; place < heights.length; place++) {
      heights[place] = zero + at[3 * place] * up[0] + at[3 * place + 1] * up[1] + at[3 * place + 2] * up[2];
    }
    this.values = { height: heights, ...points.values };
  }

  /** Colour by the named values; returns their range. */
  paint(by) {
    const values = this.values[by] ?? this.values.height;
    const range = rangeOf([values]) ?? [0, 1];
    const scale = scaleOf("viridis");
    const colour = new THREE.Color();
    // The colours of 256 levels are enough, and computed once.
    const levels = Array.from({ length: 256 }, (_, level) => colour.setRGB(...scale(level / 255), THREE.SRGBColorSpace).toArray());
    const colours = new Float32Array(3 * values.length);
    for (let place = 0; place < values.length; place++) {
      const level = Math.round(255 * Math.min(1, Math.max(0, shareOf(values[place], range))));
      colours.set(levels[level], 3 * place);
    }
    this.object.geometry.setAttribute("color", new THREE.BufferAttribute(colours, 3));
    return range;
  }

  /** The box around the points without the outermost two per cent in each direction. */
  box() {
    const box = new THREE.Box3();
    const { positions_m: at, points } = this.points;
    const ends = [0, 1, 2].map((axis) => rangeOf([Float32Array.from({ length: points }, (_, place) => at[3 * place + axis])]));
    if (ends.every(Boolean)) {
      box.min.set(...ends.map(([low]) => low)).add(this.object.position);
      box.max.set(...ends.map(([, high]) => high)).add(this.object.position);
    }
    return box;
  }

  dispose() {
    this.object.removeFromParent();
    this.object.geometry.dispose();
    this.object.material.dispose();
  }
}
