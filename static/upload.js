// Sends an image file to a challenge: in parts of the size that the server asks for, checked by the SHA-256 of the whole.
import { sha256 } from "./vendor/noble-hashes/sha2.js";

const HEADERS = { "X-SLAM-Hive": "1", Accept: "application/json" };
const BYTES = 8 * 1024 * 1024;
const AGAIN = 5;
const PAUSE_MS = 1000;
const OUT_OF_STEP = 409;

async function ask(address, options) {
  const answer = await fetch(address, { ...options, headers: { ...HEADERS, ...options.headers } });
  if (answer.ok) return answer.json();
  const problem = await answer.json().catch(() => null);
  const error = new Error(problem ? [problem.detail, problem.remedy].filter(Boolean).join("; ") : `the server answered ${answer.status}`);
  error.status = answer.status;
  throw error;
}

const post = (address, body) => ask(address, { method: "POST", body: JSON.stringify(body), headers: { "Content-Type": "application/json" } });

/** The SHA-256 of a file, which is never in memory as a whole. */
async function digestOf(file, show) {
  const hash = sha256.create();
  for (let at = 0; at < file.size; at += BYTES) {
    hash.update(new Uint8Array(await file.slice(at, at + BYTES).arrayBuffer()));
    show(Math.min(1, (at + BYTES) / file.size));
  }
  return Array.from(hash.digest(), (byte) => byte.toString(16).padStart(2, "0")).join("");
}

/** Send what is left of an upload. After a broken connection the server says where to go on. */
async function send(file, begun, address, show) {
  let upload = begun;
  for (let failures = 0; upload.received_bytes < upload.size_bytes;) {
    const at = upload.received_bytes;
    try {
      const body = file.slice(at, at + upload.part_bytes);
      upload = await ask(`${address}/parts?offset=${at}`, { method: "POST", body, headers: { "Content-Type": "application/octet-stream" } });
      failures = 0;
    } catch (error) {
      failures += 1;
      if ((error.status && error.status !== OUT_OF_STEP) || failures > AGAIN) throw error;
      await new Promise((resolve) => { setTimeout(resolve, PAUSE_MS); });
      upload = await ask(address, { method: "GET" }).catch(() => upload);
    }
    show(upload.received_bytes / upload.size_bytes);
  }
}

async function submit(form, say) {
  const { image, team, phase, algorithm } = form.elements;
  const [file] = image.files;
  const { uploads, images } = form.dataset;
  const digest = await digestOf(file, (share) => say("Reading the file.", share));
  const upload = await post(uploads, { name: file.name, size_bytes: file.size, sha256: digest });
  await send(file, upload, `${uploads}/${upload.token}`, (share) => say("Sending the file.", share));
  say("The server checks the image.", 1);
  await post(images, { upload: upload.token, team: team.value, phase: phase.value, algorithm: algorithm.value || null });
}

for (const form of document.querySelectorAll("[data-image-upload]")) {
  const [button, bar, words] = ["button", "progress", "[data-says]"].map((part) => form.querySelector(part));
  const say = (text, share = null) => {
    if (words.textContent !== text) words.textContent = text;
    bar.hidden = share === null;
    bar.value = share ?? 0;
  };
  form.hidden = false;
  form.addEventListener("submit", async (event) => {
    event.preventDefault();
    button.disabled = true;
    try {
      await submit(form, say);
      window.location.reload();
    } catch (error) {
      say(`The image was not submitted: ${error.message}.`);
      button.disabled = false;
    }
  });
}
