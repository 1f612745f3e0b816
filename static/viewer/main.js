// The 3D view of a page: loads its scene, and connects the picture with its buttons, keys and legends.
import * as THREE from "../vendor/three/three.module.min.js";
import { BY as CLOUD_BY, CloudView } from "./cloud.js";
import { scaleOf, short } from "./colours.js";
import { loadPoints, loadScene } from "./data.js";
import { BY as PATHS_BY, PathView, rangeOfPaths } from "./paths.js";
import { Playback } from "./playback.js";
import { save } from "./snapshot.js";
import { Stage } from "./stage.js";

class Viewer {
  constructor(panel, say, scene) {
    Object.assign(this, { panel, say, scene });
    this.canvas = this.find("canvas");
    this.stage = new Stage(this.canvas, scene.up);
    this.cloud = null;
    this.following = false;
    const extent = this.measure();
    // The ground truth keeps its grey, unless there is nothing else to colour.
    this.coloured = scene.paths.filter((path) => !path.truth);
    if (!this.coloured.length) this.coloured = scene.paths;
    this.paths = scene.paths.map((path) => new PathView(path, extent));
    for (const view of this.paths) this.stage.scene.add(view.group);
    this.listPaths();
    this.offer("paths", { own: true, ...Object.fromEntries(Object.keys(PATHS_BY).map((by) => [by, rangeOfPaths(by, this.coloured)])) });
    this.find("[data-paint=map]").closest("label").hidden = !scene.map;
    const [slider, output, button, rate] = ["[data-time-of-view]", "output", "[data-do=play]", "[data-rate]"].map((part) => this.find(part));
    this.playback = new Playback(scene, { slider, output, button, rate }, (time_s) => this.move(time_s));
    this.find("[data-player]").hidden = !scene.paths.length;
    this.listen();
    this.paint();
    this.stage.resize();
    this.stage.fit();
    this.stage.layGrid();
  }

  find(selector) {
    return this.panel.querySelector(selector);
  }

  /** The box around all paths; returns how long it is. */
  measure() {
    const { box } = this.stage;
    const point = new THREE.Vector3();
    for (const { positions_m: at } of this.scene.paths) {
      for (let place = 0; place < at.length; place += 3) box.expandByPoint(point.fromArray(at, place));
    }
    return box.isEmpty() ? 1 : Math.max(...box.getSize(point).toArray(), 0.1);
  }

  /** Offer only those colourings that there are values for. */
  offer(what, known) {
    const select = this.find(`[data-paint=${what}]`);
    for (const option of select.options) option.hidden = option.disabled = !known[option.value];
    if (select.selectedOptions[0].disabled) select.value = [...select.options].find((option) => !option.disabled).value;
  }

  listPaths() {
    const list = this.find("[data-paths]");
    this.swatches = this.paths.map((view) => {
      const label = document.createElement("label");
      const box = document.createElement("input");
      box.type = "checkbox";
      box.checked = true;
      box.addEventListener("change", () => {
        view.group.visible = box.checked;
        this.stage.changed();
      });
      const swatch = document.createElement("span");
      swatch.className = view.path.truth ? "viewer-swatch dashed" : "viewer-swatch";
      label.append(box, swatch, `${view.path.name} (${view.path.poses} poses)`);
      const entry = document.createElement("li");
      entry.append(label);
      list.append(entry);
      return swatch;
    });
  }

  listen() {
    const acts = {
      follow: () => this.follow(!this.following),
      reset: () => this.reset(),
      above: () => this.reset(true),
      picture: () => this.picture(),
    };
    for (const [name, act] of Object.entries(acts)) this.find(`[data-do=${name}]`).addEventListener("click", act);
    this.find("[data-paint=paths]").addEventListener("change", () => this.paint());
    this.find("[data-paint=map]").addEventListener("change", () => this.paintMap());
    this.canvas.addEventListener("keydown", (event) => this.key(event));
    this.canvas.addEventListener("webglcontextlost", (event) => {
      event.preventDefault();
      this.say("The graphics driver has dropped the picture. It comes back by itself, or when the page is loaded again.");
    });
    document.addEventListener("themechange", () => {
      this.paint();
      this.stage.layGrid();
    });
    this.stage.drawn.push(() => this.showScale());
  }

  key(event) {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const keys = {
      ArrowLeft: () => this.stage.turn(-1, 0),
      ArrowRight: () => this.stage.turn(1, 0),
      ArrowUp: () => this.stage.turn(0, 1),
      ArrowDown: () => this.stage.turn(0, -1),
      "+": () => this.stage.zoom(1),
      "=": () => this.stage.zoom(1),
      "-": () => this.stage.zoom(-1),
      ",": () => this.playback.step(-1),
      ".": () => this.playback.step(1),
      " ": () => this.playback.toggle(),
      f: () => this.follow(!this.following),
      r: () => this.reset(),
      t: () => this.reset(true),
      p: () => this.picture(),
    };
    if (!Object.hasOwn(keys, event.key)) return;
    event.preventDefault();
    event.stopPropagation();
    keys[event.key]();
  }

  follow(wanted) {
    this.following = wanted;
    this.find("[data-do=follow]").setAttribute("aria-pressed", wanted);
    this.move(this.playback.time_s);
  }

  reset(fromAbove = false) {
    this.follow(false);
    this.stage.fit(fromAbove);
  }

  /** Move all marks; the camera follows the first path that is shown and known at this time. */
  move(time_s) {
    let leader = null;
    for (const view of this.paths) {
      const position = view.move(time_s);
      if (view.group.visible) leader ??= position;
    }
    this.panel.dataset.at = leader ? leader.toArray().map((value) => value.toFixed(3)).join(" ") : "";
    if (this.following && leader) this.stage.follow(leader);
    this.stage.changed();
  }

  paint() {
    const by = this.find("[data-paint=paths]").value;
    const range = rangeOfPaths(by, this.coloured);
    for (const [place, view] of this.paths.entries()) {
      view.paint(by, this.coloured.includes(view.path) ? range : null);
      this.swatches[place].style.borderColor = view.colour;
    }
    this.explain("paths", range, "plasma", PATHS_BY[by]?.words);
    this.paintCloud();
    this.stage.changed();
  }

  /** Colours of the map; the distance to the reference map is asked for when somebody wants to see it. */
  async paintMap() {
    const by = this.find("[data-paint=map]").value;
    if (by === "error" && this.cloud && !this.cloud.values.error) {
      this.say("Comparing the map with the reference map.");
      await this.loadMap("compared").catch((error) => this.say(`The map is not compared: ${error.message}`));
    }
    this.paintCloud();
  }

  paintCloud() {
    if (!this.cloud) return;
    const by = this.find("[data-paint=map]").value;
    this.cloud.object.visible = by !== "none";
    const known = by in this.cloud.values;
    const range = known ? this.cloud.paint(by) : null;
    this.explain("map", range, "viridis", CLOUD_BY[by]);
    this.stage.changed();
  }

  /** The legend of a scale of colours; hidden without a range. */
  explain(what, range, scale, words) {
    const place = this.find(`[data-scale=${what}]`);
    place.hidden = !range;
    if (!range) return;
    const colourAt = scaleOf(scale);
    const stops = Array.from({ length: 9 }, (_, stop) => `rgb(${colourAt(stop / 8).map((part) => Math.round(255 * part)).join(" ")})`);
    place.querySelector(".viewer-ramp").style.background = `linear-gradient(to right, ${stops.join(", ")})`;
    place.querySelector("[data-low]").textContent = short(range[0]);
    place.querySelector("[data-high]").textContent = short(range[1]);
    place.querySelector("[data-words]").textContent = `${what === "map" ? "Map" : "Trajectories"}: ${words}`;
    place.dataset.text = `${what === "map" ? "Map" : "Trajectories"}: ${words} from ${short(range[0])} to ${short(range[1])}`;
  }

  showScale() {
    const { length_m, pixels } = this.stage.scale();
    const bar = this.find("[data-scale-bar]");
    bar.style.width = `${pixels}px`;
    bar.textContent = `${short(length_m)} m`;
  }

  /** Load points with this detail in place of those that are shown. */
  async loadMap(detail) {
    const points = await loadPoints(this.scene.map.address, detail);
    const cloud = new CloudView(points, this.scene.centre_m, this.scene.up);
    const first = !this.cloud;
    this.cloud?.dispose();
    this.cloud = cloud;
    this.stage.scene.add(cloud.object);
    this.offer("map", { none: true, height: true, intensity: "intensity" in points.values, error: this.scene.map.reference });
    this.paintCloud();
    if (first) this.include(cloud.box());
    this.panel.dataset.points = `${detail} ${points.points}`;
    this.told(points);
  }

  /** Show the map too, unless somebody has turned the view already. */
  include(box) {
    this.stage.box.union(box);
    if (!this.stage.touched) this.stage.fit();
    this.stage.layGrid();
  }

  told({ points, total, voxel_m }) {
    const shown = `${points.toLocaleString("en")} of ${total.toLocaleString("en")} points of the map`;
    const how = points === total ? "" : voxel_m ? `, at most one in each cube of ${short(voxel_m)} m` : ", chosen at random";
    this.words([`Shown: ${shown}${how}.`]);
  }

  words(first) {
    this.say([...first, ...this.scene.notes].join(" "));
  }

  picture() {
    const time = this.scene.paths.length ? `, ${this.playback.time_s.toFixed(2)} s` : "";
    const scales = [...this.panel.querySelectorAll("[data-scale]:not([hidden])")].map((place) => place.dataset.text);
    const names = this.paths.filter((view) => view.group.visible).map((view) => view.path.name);
    const grid = `Grid of ${short(this.stage.gridStep)} m; the bar holds at the centre of the view`;
    const lines = [`${this.scene.title}${time}`, names.join("; "), grid, ...scales].filter(Boolean);
    save(this.stage, lines, `${this.scene.title.replace(/\W+/g, "-").toLowerCase()}-3d.png`);
  }

  async showMap() {
    this.words([]);
    if (!this.scene.map) return;
    try {
      await this.loadMap("sample");
      if (this.cloud.points.points < this.scene.map.points) await this.loadMap("thinned");
    } catch (error) {
      this.words([`The map is not shown: ${error.message}.`]);
    }
  }
}

/** Open the 3D view in a panel; ``say`` shows a line of text. */
export async function open(panel, say) {
  const scene = await loadScene(panel.dataset.scene);
  if (!scene.paths.length && !scene.map) {
    say(["There is nothing to show in 3D.", ...scene.notes].join(" "));
    return;
  }
  panel.querySelector("[data-stage]").hidden = false;
  const viewer = new Viewer(panel, say, scene);
  viewer.showMap().then(() => { panel.dataset.ready = "1"; });
  viewer.canvas.focus({ preventScroll: true });
}
