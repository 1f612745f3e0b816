// Tells the reader by a notification of the browser when an experiment ends or begins to fail. It needs the page to be
// open in a tab, and the permission of the reader, who is asked on a click. The server sends nothing for it.
"use strict";
(() => {
  const button = document.getElementById("notify");
  const head = document.getElementById("head");
  if (!button || !head || !("Notification" in window)) return;
  const name = button.dataset.experiment;
  const key = `slamhive-notify-${name}`;
  const ENDED = ["finished", "cancelled"];
  const outcome = () => document.querySelector("#head [data-standing]");
  const standing = () => outcome().dataset.standing;
  const failing = () => Number(document.querySelector("#head [data-failing]")?.dataset.failing ?? 0);
  let before = standing();
  let failed = failing();

  const wanted = () => {
    try { return localStorage.getItem(key) === "yes" && Notification.permission === "granted"; } catch { return false; }
  };
  const remember = (on) => { try { localStorage.setItem(key, on ? "yes" : "no"); } catch { /* not kept, then */ } };

  function show() {
    const place = document.getElementById("notify");
    if (!place) return;
    place.hidden = ENDED.includes(standing());
    place.setAttribute("aria-pressed", String(wanted()));
    place.textContent = wanted() ? "Notifies you" : "Notify me";
  }

  function tell(title) {
    const note = new Notification(title, { body: outcome().textContent.trim(), tag: key });
    note.addEventListener("click", () => { window.focus(); note.close(); });
  }

  document.addEventListener("click", async (event) => {
    if (event.target.id !== "notify") return;
    const on = !wanted();
    if (on && Notification.permission === "default") await Notification.requestPermission();
    remember(on && Notification.permission === "granted");
    if (Notification.permission === "denied") event.target.title = "This browser blocks notifications of this page.";
    show();
  });

  document.addEventListener("pageswap", () => {
    const now = standing();
    if (wanted() && now !== before && ENDED.includes(now)) tell(`Experiment ${name} has ${now === "finished" ? "finished" : "been cancelled"}`);
    if (wanted() && failing() && !failed && !ENDED.includes(now)) tell(`Experiment ${name} is failing`);
    before = now;
    failed = failing();
    show();
  });
  show();
})();
