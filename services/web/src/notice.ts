/** What must not be overlooked: a map that lies nowhere in particular, and photos that wait to be tied in. */

import type { Mission } from "./api";
import { fill, h, text } from "./dom";
import { count } from "./format";

export class Notice {
  readonly root = h("div", { class: "notice", role: "status", hidden: true });
  private readonly local = h("p", {});
  private readonly height = h("input", { type: "number", min: 1, max: 99999, step: "any", required: true, "aria-label": "Height of the first photo above ground, metres" });
  private readonly form = h("form", { class: "scale" }, h("span", {}, "First photo at"), this.height, h("span", {}, "m"), h("button", { type: "submit" }, "Set scale"));
  private readonly parts = h("p");
  private readonly waiting = h("p", { class: "waiting" });

  constructor(setHeight: (height_m: number) => void) {
    fill(this.root, this.local, this.parts, this.form, this.waiting);
    this.form.addEventListener("submit", (event) => {
      event.preventDefault();
      setHeight(this.height.valueAsNumber);
      this.height.blur();
    });
  }

  /** `parts`: maps that no photo ties together. */
  set({ georeferenced, scale, progress }: Mission, parts: number): void {
    const late = progress.counts.waiting;
    const local = georeferenced === false;
    this.root.hidden = !local && late === 0;
    this.local.hidden = this.form.hidden = !local;
    this.waiting.hidden = late === 0;
    this.parts.hidden = !local || parts < 2;
    text(this.parts, `No photo ties its ${parts} parts together: they are drawn side by side.`);
    fill(this.local, h("strong", {}, "Not georeferenced. "), scale
      ? "No photo has GPS: place and north are assumed, the scale is as it was given."
      : "No photo has GPS: place, north and scale are assumed. Do not measure in it.");
    if (document.activeElement !== this.height && scale?.first_height_m) this.height.value = String(scale.first_height_m);
    text(this.waiting, late === 1
      ? "1 photo without GPS waits for a tie. It is kept, and goes onto the map as soon as another photo shows the same ground."
      : `${count(late, "photo")} without GPS wait for a tie. They are kept, and go onto the map as soon as another photo shows the same ground.`);
  }
}
