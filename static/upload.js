// Sends files in parts of the size that the server asks for, checked by the SHA-256 of the whole: an image to a challenge,
// and recordings and packages to import.
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

/** The upload of a file, complete. One that was begun before, also on another page, goes on where it ended. */
async function sent(file, uploads, say) {
  const digest = await digestOf(file, (share) => say(`Reading ${file.name}.`, share));
  const known = (await ask(uploads, { method: "GET" })).uploads;
  const begun = known.find((entry) => entry.sha256 === digest && entry.name === file.name && !entry.imported);
  const upload = begun ?? await post(uploads, { name: file.name, size_bytes: file.size, sha256: digest });
  await send(file, upload, `${uploads}/${upload.token}`, (share) => say(`Sending ${file.name}.`, share));
  return upload.token;
}

async function submitImage(form, say) {
  const { image, team, phase, algorithm } = form.elements;
  const { uploads, images } = form.dataset;
  const upload = await sent(image.files[0], uploads, say);
  say("The server checks the image.", 1);
  await post(images, { upload, team: team.value, phase: phase.value, algorithm: algorithm.value || null });
  window.location.reload();
}

/** Send the files of a form, then the form itself with the tokens of their uploads. */
async function submitFiles(form, say) {
  form.querySelectorAll("[data-sent]").forEach((field) => field.remove());
  for (const field of form.querySelectorAll("[data-becomes]")) {
    for (const file of field.files) {
      const token = await sent(file, form.dataset.uploads, say);
      const hidden = document.createElement("input");
      Object.assign(hidden, { type: "hidden", name: field.dataset.becomes, value: token });
      hidden.dataset.sent = "";
      form.append(hidden);
    }
  }
  say("The server looks at it.", 1);
  form.submit();
}

function prepare(form, submit, refusal) {
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
    } catch (error) {
      say(`${refusal}: ${error.message}.`);
      button.disabled = false;
    }
  });
  addEventListener("pageshow", () => { button.disabled = false; });
}

document.querySelectorAll("[data-image-upload]").forEach((form) => prepare(form, submitImage, "The image was not submitted"));
document.querySelectorAll("[data-send-files]").forEach((form) => prepare(form, submitFiles, "It was not sent"));
