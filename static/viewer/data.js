// Reads what the server sends: paths as JSON with packed numbers, points of maps as bytes.

const ARRAYS = { f4: Float32Array, i4: Int32Array };

/** Packed numbers, as the plots have them, as a typed array; null stays null. */
function unpacked(packed) {
  if (!packed) return null;
  const bytes = Uint8Array.from(atob(packed.bdata), (character) => character.charCodeAt(0));
  return new ARRAYS[packed.dtype](bytes.buffer);
}

async function fetched(address, accept) {
  const answer = await fetch(address, { headers: { Accept: accept } });
  if (answer.ok) return answer;
  const problem = await answer.json().catch(() => null);
  throw new Error(problem?.error?.message ?? `the server answered ${answer.status}`);
}

export async function loadScene(address) {
  const scene = await (await fetched(address, "application/json")).json();
  for (const path of scene.paths) {
    for (const key of ["times_s", "positions_m", "pieces", "speeds_mps", "errors_m"]) path[key] = unpacked(path[key]);
  }
  return scene;
}

/** Points of a map: {total, voxel_m, origin_m, positions_m, values: {name: Float32Array}}. */
export async function loadPoints(address, detail) {
  const answer = await fetched(`${address}?detail=${detail}`, "application/octet-stream, application/json");
  const buffer = await answer.arrayBuffer();
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
