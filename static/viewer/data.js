// Reads what a server sends, or what the scripts of a static site hold: paths as JSON with packed numbers, points of maps as bytes.

const ARRAYS = { f4: Float32Array, i4: Int32Array };

const bufferOf = (base64) => Uint8Array.from(atob(base64), (character) => character.charCodeAt(0)).buffer;

/** Packed numbers, as the plots have them, as a typed array; null stays null. */
const unpacked = (packed) => packed ? new ARRAYS[packed.dtype](bufferOf(packed.bdata)) : null;

/** What the script at an address of a static site puts into slamhiveData under its name. */
async function fromScript(address) {
  await window.slamhiveLoad(address);
  return window.slamhiveData[address.split("/").pop()];
}

const isScript = (address) => address.endsWith(".js");

async function fetched(address, accept) {
  const answer = await fetch(address, { headers: { Accept: accept } });
  if (answer.ok) return answer;
  const problem = await answer.json().catch(() => null);
  throw new Error(problem?.error?.message ?? `the server answered ${answer.status}`);
}

async function oneScene(address) {
  const scene = isScript(address) ? await fromScript(address) : await (await fetched(address, "application/json")).json();
  for (const path of scene.paths) {
    for (const key of ["times_s", "positions_m", "pieces", "speeds_mps", "errors_m"]) path[key] = unpacked(path[key]);
  }
  return scene;
}

/** The first path of each run, in the frame of their ground truth, with its colours. Runs without one are named. */
async function comparedScene(runs) {
  const scenes = await Promise.all(runs.map(({ address }) => oneScene(address)));
  const truths = scenes.map(({ paths }) => paths.find(({ truth }) => truth));
  const first = scenes[truths.findIndex(Boolean)];
  const without = runs.filter((_, place) => !truths[place]).map(({ name }) => name);
  const notes = without.length ? [`Not shown, because no ground truth says where they are: ${without.join(", ")}.`] : [];
  if (!first) return { ...scenes[0], title: "Comparison of runs", paths: [], map: null, notes };
  const from_s = Math.min(...scenes.map((scene) => scene.from_s));
  const moved = (scene, path, look) => ({
    ...path,
    ...look,
    times_s: path.times_s.map((time_s) => time_s + scene.from_s - from_s),
    positions_m: path.positions_m.map((value, place) => value + scene.centre_m[place % 3] - first.centre_m[place % 3]),
  });
  const paths = scenes.flatMap((scene, place) => truths[place] ? [moved(scene, scene.paths[0], runs[place])] : []);
  paths.push(moved(first, truths.find(Boolean), {}));
  const until_s = Math.max(...scenes.map((scene) => scene.from_s + scene.duration_s));
  return { ...first, title: "Comparison of runs", from_s, duration_s: until_s - from_s, paths, map: null, notes };
}

/** The scene at an address; of several runs of a static site if it is JSON: [{address, name, colour, dark}]. */
export const loadScene = (address) => address.startsWith("[") ? comparedScene(JSON.parse(address)) : oneScene(address);

/** Points of a map: {total, voxel_m, origin_m, positions_m, values: {name: Float32Array}}. */
export async function loadPoints(address, detail) {
  const asked = () => fetched(`${address}?detail=${detail}`, "application/octet-stream, application/json");
  const buffer = isScript(address) ? bufferOf(await fromScript(address)) : await (await asked()).arrayBuffer();
  const size = new DataView(buffer).getUint32(0, true);
  const header = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, size)));
  const positions_m = new Float32Array(buffer, 4 + size, 3 * header.points);
  const values = {};
  let at = 4 + size + positions_m.byteLength;
  for (const { name, low, high } of header.values) {
    const levels = new Uint16Array(buffer, at, header.points);
    values[name] = Float32Array.from(levels, (level) => low + (level / 65535) * (high - low));
    at += Math.ceil(levels.byteLength / 4) * 4;
  }
  return { ...header, positions_m, values };
}
