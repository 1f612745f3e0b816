// Says on pages of a static site that runs side by side are not comparable, by the rule and in the words of
// domain/side_by_side.py: a page from a folder cannot ask a server about the runs that somebody has just chosen.
"use strict";
(() => {
  const MOST_NAMED = 3;
  const before = (a, b) => (a < b ? -1 : Number(a > b));

  /** Each label without the words that all of them share, so that they differ and stay short. */
  function shortNames(labels) {
    const words = labels.map((label) => label.split(", "));
    const shared = new Set(labels).size > 1 ? words[0].filter((word) => words.every((entry) => entry.includes(word))) : [];
    const short = words.map((entry) => entry.filter((word) => !shared.includes(word)));
    const named = short.every((entry) => entry.length) ? short : words.map(([first, ...others]) => [first, ...others.filter((word) => !shared.includes(word))]);
    return named.map((entry) => entry.join(", "));
  }

  /**
   * Why runs are not comparable, or null.
   * @param uses - [fingerprint, label with the kind of trajectory, kind of trajectory or null] of each evaluated run.
   */
  function mixed(uses) {
    const counts = new Map();
    for (const use of uses) {
      const key = JSON.stringify(use);
      counts.set(key, { use, runs: (counts.get(key)?.runs ?? 0) + 1 });
    }
    const found = [...counts.values()];
    const stated = found.filter(({ use: [, , kind] }) => kind !== null);
    const protocols = new Set(found.map(({ use: [fingerprint] }) => fingerprint)).size;
    const labels = new Set((stated.length ? stated : found).map(({ use: [, label] }) => label));
    if (protocols < 2 && labels.size < 2) return null;
    found.sort(({ use: a, runs: many }, { use: b, runs: few }) => few - many || (a[2] === null) - (b[2] === null) || before(a[1], b[1]) || before(a[0], b[0]));
    const onlyTrajectories = protocols === 1;
    const names = onlyTrajectories ? found.map(({ use: [, , kind] }) => (kind === null ? "an unstated one" : `the ${kind.replace(/s$/, "")} trajectory`)) : shortNames(found.map(({ use: [, label] }) => label));
    const told = found.slice(0, MOST_NAMED).map(({ runs }, place) => `${runs.toLocaleString("en")}${place ? "" : runs === 1 ? " run uses" : " runs use"} ${names[place]}`);
    const rest = found.slice(MOST_NAMED).reduce((sum, { runs }) => sum + runs, 0);
    const sign = names.some((name) => name.includes(", ")) ? "; " : ", ";
    return { words: `${[...told, ...(rest ? [`${rest} others`] : [])].join(sign)}: not comparable.`, protocols, onlyTrajectories };
  }

  /** Show why these runs are not comparable above them, or nothing. */
  function show(uses) {
    const found = mixed(uses);
    const banner = document.querySelector("[data-mixed]");
    banner.hidden = found === null;
    banner.querySelector("strong").textContent = found?.words ?? "";
    banner.querySelector("[data-kinds]").hidden = !found?.onlyTrajectories;
    return found;
  }

  window.slamhiveProtocols = { mixed, show };
})();
