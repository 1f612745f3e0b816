// The present time of all views: slider, playback, and the moments that other plots of the page announce.

const ANNOUNCE_MS = 1000;
const SETTLED_MS = 150;
const STILL_MS = 500;

export class Playback {
  /**
   * @param {{from_s: number, duration_s: number}} scene - The clock.
   * @param {{slider: HTMLInputElement, output: HTMLOutputElement, button: HTMLButtonElement, rate: HTMLSelectElement}} parts
   * @param {(time_s: number) => void} moved - Told of each new time, in s from the start.
   */
  constructor(scene, parts, moved) {
    Object.assign(this, { scene, parts, moved });
    this.time_s = 0;
    this.playing = false;
    this.announced = 0;
    this.timer = null;
    this.still = window.matchMedia("(prefers-reduced-motion: reduce)");
    parts.slider.max = scene.duration_s;
    parts.slider.step = Math.max(0.001, scene.duration_s / 10000).toPrecision(1);
    parts.slider.addEventListener("input", () => {
      this.set(Number(parts.slider.value));
      this.announceSoon();
    });
    parts.button.addEventListener("click", () => this.toggle());
    document.addEventListener("moment", ({ detail }) => {
      if (!this.announcing) this.set(detail - scene.from_s);
    });
    // A view that is opened later starts at the moment that the page shows.
    this.set((window.slamhiveMoment ?? scene.from_s) - scene.from_s);
  }

  set(time_s) {
    this.time_s = Math.min(this.scene.duration_s, Math.max(0, time_s));
    this.parts.slider.value = this.time_s;
    this.parts.output.textContent = `${this.time_s.toFixed(2)} s`;
    this.moved(this.time_s);
  }

  /** One step of the slider's width in hundredths. */
  step(hundredths) {
    this.set(this.time_s + (hundredths / 100) * this.scene.duration_s);
    this.announceSoon();
  }

  toggle() {
    this.playing = !this.playing;
    this.parts.button.textContent = this.playing ? "Pause" : "Play";
    if (!this.playing) {
      this.announce();
      return;
    }
    if (this.time_s >= this.scene.duration_s) this.set(0);
    this.next(performance.now());
  }

  /** Play on; with reduced motion in two steps a second instead of as often as the screen is drawn. */
  next(before) {
    const again = this.still.matches ? (step) => setTimeout(() => step(performance.now()), STILL_MS) : requestAnimationFrame;
    again((now) => {
      if (!this.playing) return;
      this.set(this.time_s + ((now - before) / 1000) * Number(this.parts.rate.value));
      if (now - this.announced > ANNOUNCE_MS) this.announce();
      if (this.time_s >= this.scene.duration_s) this.toggle();
      else this.next(now);
    });
  }

  announceSoon() {
    clearTimeout(this.timer);
    this.timer = setTimeout(() => this.announce(), SETTLED_MS);
  }

  /** Tell the other views of the page, which read files for each moment, so not for each picture. */
  announce() {
    this.announced = performance.now();
    this.announcing = true;
    document.dispatchEvent(new CustomEvent("moment", { detail: this.scene.from_s + this.time_s }));
    this.announcing = false;
  }
}
