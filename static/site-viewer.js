// Modules for pages in a folder, which browsers do not let load any: their text comes in a script, and becomes modules here.
"use strict";
(() => {
  let made = null;

  /** The address of the last module, which imports the others. Each comes after those that it imports. */
  function addressOf(modules) {
    const addresses = {};
    let last = null;
    for (const [name, text, imports] of modules) {
      let own = text;
      for (const [quoted, other] of Object.entries(imports)) own = own.replaceAll(quoted, `"${addresses[other]}"`);
      last = addresses[name] = URL.createObjectURL(new Blob([own], { type: "text/javascript" }));
    }
    return last;
  }

  window.slamhiveModuleOf = async (address) => {
    if (!made) {
      await slamhiveLoad(address);
      made = addressOf(window.slamhiveModules);
    }
    return made;
  };
})();
