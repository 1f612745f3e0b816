// The picture: camera, controls, grid and scale. It is drawn only when something has changed.
import * as THREE from "../vendor/three/three.module.min.js";
import { OrbitControls } from "../vendor/three/OrbitControls.js";
import { isDark } from "./colours.js";

const FIELD_OF_VIEW_DEG = 45;
const TURN_RAD = 0.1;
const NEARER = 0.85;
const GRID_LINES = 20;
const SCALE_PX = 110;

/** The largest of 1, 2, 5, 10, 20, ... that is not larger. */
export function roundDown(length) {
  const power = 10 ** Math.floor(Math.log10(length));
  return [5, 2, 1].find((step) => step * power <= length * 1.0001) * power;
}

export class Stage {
  constructor(canvas, up) {
    this.canvas = canvas;
    this.up = new THREE.Vector3(...up);
    this.renderer = new THREE.WebGLRenderer({ canvas, antialias: true, alpha: true });
    this.renderer.setPixelRatio(Math.min(2, window.devicePixelRatio || 1));
    this.scene = new THREE.Scene();
    this.camera = new THREE.PerspectiveCamera(FIELD_OF_VIEW_DEG, 1, 0.1, 1000);
    this.camera.up.copy(this.up);
    this.controls = new OrbitControls(this.camera, canvas);
    this.controls.addEventListener("change", () => this.changed());
    this.controls.addEventListener("start", () => { this.touched = true; });
    this.touched = false;
    this.box = new THREE.Box3();
    this.drawn = [];
    this.waiting = false;
    new ResizeObserver(() => this.resize()).observe(canvas.parentElement);
    canvas.addEventListener("webglcontextrestored", () => this.changed());
  }

  /** Draw soon, once, however many changes there are until then. */
  changed() {
    if (this.waiting) return;
    this.waiting = true;
    requestAnimationFrame(() => {
      this.waiting = false;
      this.draw();
    });
  }

  draw() {
    this.renderer.render(this.scene, this.camera);
    for (const told of this.drawn) told();
  }

  resize() {
    const { clientWidth: width, clientHeight: height } = this.canvas.parentElement;
    if (!width || !height) return;
    this.renderer.setSize(width, height, false);
    this.camera.aspect = width / height;
    this.camera.updateProjectionMatrix();
    this.changed();
  }

  /** Show the box: from the side and above, or straight from above. */
  fit(fromAbove = false) {
    this.touched = fromAbove;
    const middle = this.box.getCenter(new THREE.Vector3());
    const radius = Math.max(this.box.getSize(new THREE.Vector3()).length() / 2, 0.05);
    const forwards = Math.abs(this.up.x) > 0.5 ? new THREE.Vector3(0, -1, 0) : new THREE.Vector3(0.45, -0.7, 0.45);
    forwards.addScaledVector(this.up, -forwards.dot(this.up)).normalize();
    const direction = forwards.multiplyScalar(fromAbove ? 0.001 : 0.8).addScaledVector(this.up, fromAbove ? 1 : 0.6).normalize();
    const half = Math.atan(Math.tan((FIELD_OF_VIEW_DEG * Math.PI) / 360) * Math.min(1, this.camera.aspect));
    this.camera.position.copy(middle).addScaledVector(direction, (0.9 * radius) / Math.sin(half));
    this.camera.near = radius / 500;
    this.camera.far = radius * 100;
    this.camera.updateProjectionMatrix();
    this.controls.target.copy(middle);
    this.controls.update();
    this.changed();
  }

  /** Move camera and target together, so that the target is here. */
  follow(position) {
    this.touched = true;
    const step = position.clone().sub(this.controls.target);
    this.camera.position.add(step);
    this.controls.target.add(step);
    this.controls.update();
    this.changed();
  }

  /** Turn around the target: to the side and upwards, in steps. */
  turn(aside, upwards) {
    this.touched = true;
    const arm = this.camera.position.clone().sub(this.controls.target);
    arm.applyAxisAngle(this.up, -aside * TURN_RAD);
    const angle = arm.angleTo(this.up);
    const wanted = Math.min(Math.PI - 0.05, Math.max(0.05, angle - upwards * TURN_RAD));
    const axis = new THREE.Vector3().crossVectors(this.up, arm).normalize();
    if (axis.lengthSq() > 0.5) arm.applyAxisAngle(axis, wanted - angle);
    this.camera.position.copy(this.controls.target).add(arm);
    this.controls.update();
    this.changed();
  }

  zoom(steps) {
    this.touched = true;
    this.camera.position.sub(this.controls.target).multiplyScalar(NEARER ** steps).add(this.controls.target);
    this.controls.update();
    this.changed();
  }

  /** A grid below everything; its step is what ``gridStep`` says. */
  layGrid() {
    this.grid?.removeFromParent();
    const size = this.box.getSize(new THREE.Vector3());
    const longest = Math.max(size.x, size.y, size.z, 0.1);
    this.gridStep = roundDown((longest * 1.2) / (GRID_LINES / 2));
    const count = 2 * Math.ceil((longest * 0.6) / this.gridStep);
    const colour = new THREE.Color(isDark() ? "#3a4047" : "#d5d9de");
    this.grid = new THREE.GridHelper(count * this.gridStep, count, colour, colour);
    this.grid.quaternion.setFromUnitVectors(new THREE.Vector3(0, 1, 0), this.up);
    const middle = this.box.getCenter(new THREE.Vector3());
    const lowest = ["x", "y", "z"].reduce((sum, axis) => sum + Math.abs(this.up[axis]) * size[axis], 0) / 2;
    this.grid.position.copy(middle).addScaledVector(this.up, -lowest);
    this.scene.add(this.grid);
    this.changed();
  }

  /** A round length and how many pixels it has at the centre of the view. */
  scale() {
    const distance = this.camera.position.distanceTo(this.controls.target);
    const metres = (2 * distance * Math.tan((FIELD_OF_VIEW_DEG * Math.PI) / 360)) / this.canvas.clientHeight;
    const length_m = roundDown(metres * SCALE_PX);
    return { length_m, pixels: length_m / metres };
  }
}
