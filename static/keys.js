// Keyboard shortcuts of every page: / finds, ? lists them, g and a letter open a page.
"use strict";
(() => {
  const WAIT_MS = 1200;
  const PAGES = { h: 0, e: 1, r: 2, a: 3, c: 4, l: 5, d: 6 };
  const links = document.querySelectorAll(".top ul a");
  let goesUntil = 0;

  const typing = (target) => target.isContentEditable || /^(INPUT|TEXTAREA|SELECT)$/.test(target.tagName);

  document.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey || typing(event.target)) return;
    const going = event.timeStamp < goesUntil;
    goesUntil = 0;
    if (event.key === "/") document.getElementById("find").focus();
    else if (event.key === "?") document.getElementById("keys").showModal();
    else if (event.key === "g" && !going) goesUntil = event.timeStamp + WAIT_MS;
    else if (going && event.key in PAGES) links[PAGES[event.key]].click();
    else return;
    event.preventDefault();
  });
})();
