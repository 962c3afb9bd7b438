/** The front page: all missions, and the place to drop a flight's photos on. */

import { api, type Mission } from "./api";
import { fill, h, icon, ICONS } from "./dom";
import { ago, count } from "./format";
import { reached } from "./panel";
import { dropTarget } from "./uploads";

const REFRESH_MS = 4000;
const LABEL = { open: "Live", finalising: "Finalising", sharpening: "Sharpening", final: "Final", deleting: "Being deleted" } as const;
const TONE = { open: "live", finalising: "busy", sharpening: "busy", final: "done", deleting: "off" } as const;

export type OpenMission = (id: string, photos: File[]) => void;

function row({ id, name, state, created_at, progress }: Mission): HTMLElement {
  const { fused } = reached(progress.counts);
  const good = progress.total - progress.counts.rejected;
  const waiting = state === "open" && progress.total === 0;
  const meter = h("span", { class: "meter" }, h("i"));
  if (meter.firstElementChild instanceof HTMLElement) meter.firstElementChild.style.width = good ? `${(100 * fused) / good}%` : "0";
  return h("li", {},
    h("a", { href: `/missions/${id}`, "data-route": true, class: "mission-row" },
      h("span", { class: "mission-name" }, h("strong", {}, name), h("small", {}, ago(created_at))),
      h("span", { class: "mission-count" },
        h("span", {}, good ? `${fused.toLocaleString("en")} of ${count(good, "photo")} on the map` : "no photos yet",
          progress.counts.waiting > 0 && h("small", {}, ` · ${progress.counts.waiting} waiting`),
          progress.counts.rejected > 0 && h("em", {}, ` · ${progress.counts.rejected} rejected`)),
        meter),
      h("span", { class: "pill", "data-tone": waiting ? "off" : TONE[state] }, waiting ? "Waiting" : LABEL[state])));
}

export class MissionsPage {
  private readonly list = h("ul", { class: "mission-list", "aria-label": "Missions" });
  private readonly more = h("button", { class: "quiet more", hidden: true, onclick: () => void this.loadMore() }, "Older missions");
  private readonly message = h("p", { class: "offline", role: "alert", hidden: true });
  private readonly name = h("input", { type: "text", name: "name", maxlength: 120, placeholder: "Name, e.g. River bank east", autocomplete: "off", "aria-label": "Name of the new mission" });
  private readonly undoDrop: () => void;
  private timer = 0;
  private gone = false;
  private next: string | null = null;

  constructor(root: HTMLElement, private readonly openMission: OpenMission) {
    const file = h("input", { type: "file", multiple: true, hidden: true, accept: "image/jpeg,image/tiff,.jpg,.jpeg,.tif,.tiff,.mpo" });
    file.addEventListener("change", () => void this.create([...(file.files ?? [])]));
    const form = h("form", { class: "new-mission" }, this.name, h("button", { class: "primary", type: "submit" }, icon(ICONS.plus), "New mission"));
    form.addEventListener("submit", (event) => {
      event.preventDefault();
      void this.create([]);
    });
    fill(root, h("main", { class: "home" },
      h("header", { class: "home-head" }, h("a", { class: "brand", href: "/", "data-route": true }, h("i", { class: "mark" }), "Orthostream"),
        h("a", { class: "docs", href: "/docs", "data-route": true }, "API")),
      h("section", { class: "hero" },
        h("h1", {}, "Maps that grow while the drones fly"),
        h("button", { class: "dropzone", type: "button", onclick: () => file.click() }, icon(ICONS.upload),
          h("strong", {}, "Drop a flight’s photos here"), h("span", {}, "or choose them. A new mission starts at once.")),
        file, form, this.message),
      h("section", { class: "missions" }, h("h2", {}, "Missions"), this.list, this.more)));
    this.undoDrop = dropTarget(root, (files) => void this.create(files));
    document.title = "Orthostream";
    void this.load();
  }

  destroy(): void {
    this.gone = true;
    clearTimeout(this.timer);
    this.undoDrop();
  }

  private async load(): Promise<void> {
    try {
      const page = await api.missions();
      if (this.gone) return;
      this.message.hidden = true;
      this.show(page.missions, page.next);
    } catch {
      if (this.gone) return;
      this.say("The server cannot be reached. Trying again…");
    }
    this.timer = window.setTimeout(() => void this.load(), REFRESH_MS);
  }

  private show(missions: Mission[], next: string | null): void {
    this.next = next;
    this.more.hidden = !next;
    if (missions.length) fill(this.list, ...missions.map(row));
    else fill(this.list, h("li", { class: "note" }, "No mission yet. The first one starts with a photo."));
  }

  private async loadMore(): Promise<void> {
    // Older pages are looked at, not watched: refreshing stops so that they stay in place.
    clearTimeout(this.timer);
    const page = await api.missions(this.next);
    this.next = page.next;
    this.more.hidden = !page.next;
    this.list.append(...page.missions.map(row));
  }

  private async create(photos: File[]): Promise<void> {
    const when = new Date().toLocaleString("en", { day: "numeric", month: "short", hour: "2-digit", minute: "2-digit", hour12: false });
    try {
      const mission = await api.create(this.name.value.trim() || `Flight of ${when}`);
      this.openMission(mission.id, photos);
    } catch (error) {
      this.say(error instanceof Error ? error.message : "The mission could not be created.");
    }
  }

  private say(message: string): void {
    this.message.textContent = message;
    this.message.hidden = false;
  }
}
