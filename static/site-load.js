// Loads further scripts of a static site: pages in a folder cannot fetch files, but have scripts.
"use strict";
window.slamhiveLoad = (address) => new Promise((resolve, reject) => {
  const script = document.createElement("script");
  script.src = address;
  script.onload = resolve;
  script.onerror = () => reject(new Error(`${address} is missing`));
  document.head.append(script);
});
