/** The mission's panel: what came in, what is on the map, what was refused and why, what can be taken away. */

import { type Counts, type ExportDoc, type Frame, type Mission, type MissionState, type Progress, type Submaps } from "./api";
import { fill, h, icon, ICONS, text } from "./dom";
import { bytes, count, seconds } from "./format";
import { Notice } from "./notice";
import { SubmapsSection } from "./submaps";

const STATE: Record<MissionState, [label: string, tone: string]> = {
  open: ["Live", "live"],
  finalising: ["Finalising", "busy"],
  sharpening: ["Sharpening", "busy"],
  final: ["Final", "done"],
  deleting: ["Being deleted", "off"],
};

const EXPORT_TITLES: Record<string, [title: string, hint: string]> = {
  "mosaic.tif": ["Orthophoto", "GeoTIFF (COG)"],
  "preview.png": ["Preview", "PNG, 2048 px"],
  "preview.zip": ["Preview", "PNG with world file"],
  "tiles.pmtiles": ["Map tiles", "PMTiles"],
  "tiles.mbtiles": ["Map tiles", "MBTiles"],
  "tiles.zip": ["Map tiles", "XYZ folder, zip"],
  "map.kmz": ["Google Earth", "KMZ super-overlay"],
  "stac.json": ["Catalogue entry", "STAC item"],
  "footprints.geojson": ["Footprints", "GeoJSON"],
  "poses.json": ["Camera poses", "JSON, UTM"],
  "route.csv": ["Flight route", "CSV"],
  "report.json": ["Report", "JSON"],
};

export interface PanelActions {
  finalise(): void;
  add(files: File[]): void;
  toggle(layer: "footprint" | "track", visible: boolean): void;
  share(): void;
  setHeight(height_m: number): void;
  download(doc: ExportDoc): void;
}

export type LegendEntry = [label: string, colour: string];

function legendEntry([label, colour]: LegendEntry): HTMLElement {
  const swatch = h("i");
  swatch.style.background = colour;
  return h("li", {}, swatch, label);
}

/** How many photos have come at least so far along the chain. */
export function reached(counts: Counts): { matched: number; posed: number; fused: number } {
  const fused = counts.fused;
  const posed = counts.posed + fused;
  return { matched: counts.matched + counts.waiting + posed, posed, fused };
}

const FAILED = "failed";

/** How large a file is can be told while it is the one that a click brings: a map that grew since has another. */
function exportNote(doc: ExportDoc, wanted: boolean, revision: number): string {
  if (wanted) return "being made…";
  if (doc.state === "failed") return FAILED;
  return doc.state === "ready" && doc.revision === revision && doc.size_bytes !== null ? bytes(doc.size_bytes) : "";
}

function stat(label: string, hint: string): { root: HTMLElement; value: HTMLElement } {
  const value = h("dd", {}, "–");
  return { root: h("div", { class: "stat", title: hint }, h("dt", {}, label), value), value };
}

export class Panel {
  readonly root: HTMLElement;
  private readonly title = h("h1");
  private readonly pill = h("span", { class: "pill", role: "status" });
  private readonly offline = h("p", { class: "offline", role: "alert", hidden: true }, "Connection lost. Trying again…");
  private readonly headline = h("strong", { class: "headline-number" }, "0");
  private readonly headlineRest = h("span", { class: "muted" }, "photos on the map");
  private readonly bar = h("div", { class: "bar", role: "img" });
  private readonly notice: Notice;
  private readonly submaps = new SubmapsSection();
  private colours: ReadonlyMap<string, string> = new Map();
  private hangingTogether: Submaps = { maps: [], submaps: [], ties: [] };
  private mission: Mission | null = null;
  private readonly stages = {
    uploaded: stat("Uploaded", "Photos that arrived and are safe"),
    matched: stat("Matched", "Compared with their neighbours"),
    posed: stat("Posed", "Position and direction are known"),
    fused: stat("On the map", "Pixels are in the published tiles"),
    rejected: stat("Rejected", "Could not be used; the reasons are below"),
  };
  private readonly figures = {
    rate: stat("Rate", "Photos put on the map per second, over the last minute"),
    p50: stat("Photo → map", "Median time from upload to visible tile"),
    p95: stat("95 %", "95 of 100 photos were on the map within this time"),
    revision: stat("Revision", "How many times the map was published"),
  };
  private readonly rejectedCount = h("span", { class: "badge" });
  private readonly rejectedList = h("ul", { class: "rejected" });
  private readonly rejected = h("details", { class: "section", hidden: true });
  private readonly downloads = h("ul", { class: "downloads" });
  private readonly drones = h("ul", { class: "legend" });
  private readonly sources = h("ul", { class: "legend" });
  private readonly uploadNote = h("p", { class: "note", hidden: true, role: "status" });
  private readonly finalise: HTMLButtonElement;
  private readonly finaliseHint = h("p", { class: "note" });
  private lastLegend = "";
  private exports: ExportDoc[] = [];
  private wanted: ReadonlySet<string> = new Set();
  private lastExports = "";

  constructor(private readonly actions: PanelActions) {
    this.finalise = h("button", { class: "primary", onclick: () => actions.finalise() }, icon(ICONS.check), "Finalise map");
    this.notice = new Notice((height_m) => actions.setHeight(height_m));
    this.rejected.append(h("summary", {}, "Rejected photos", this.rejectedCount), this.rejectedList);
    this.root = h("aside", { class: "panel", "aria-label": "Mission" }, this.head(), this.body(), this.foot());
  }

  private head(): HTMLElement {
    const expand = h("button", { class: "icon-button expand", "aria-label": "Show or hide the details", "aria-expanded": "false" }, icon(ICONS.chevron));
    expand.addEventListener("click", () => {
      const open = this.root.classList.toggle("open");
      expand.setAttribute("aria-expanded", String(open));
    });
    return h(
      "header", { class: "panel-head" },
      h("div", { class: "crumbs" },
        h("a", { href: "/", "data-route": true, class: "back" }, icon(ICONS.back), "Missions"),
        h("button", { class: "icon-button share", title: "Copy the link to this map", "aria-label": "Copy the link to this map", onclick: () => this.actions.share() }, icon(ICONS.link)),
        expand),
      h("div", { class: "title-row" }, this.title, this.pill),
      this.offline,
      h("p", { class: "headline" }, this.headline, this.headlineRest),
      this.bar,
      this.notice.root,
    );
  }

  private body(): HTMLElement {
    return h(
      "div", { class: "panel-body" },
      h("dl", { class: "stages" }, ...Object.values(this.stages).map((s) => s.root)),
      h("dl", { class: "figures" }, ...Object.values(this.figures).map((s) => s.root)),
      h("section", { class: "section" }, h("h2", {}, "Layers"),
        this.switch("Photo footprints", "footprint"), this.sources, this.switch("Flight tracks", "track"), this.drones),
      this.submaps.root,
      this.rejected,
      h("section", { class: "section" }, h("h2", {}, "Downloads"), this.downloads),
    );
  }

  private foot(): HTMLElement {
    const input = h("input", { type: "file", multiple: true, accept: "image/jpeg,image/tiff,.jpg,.jpeg,.tif,.tiff,.mpo", hidden: true });
    input.addEventListener("change", () => {
      this.actions.add([...(input.files ?? [])]);
      input.value = "";
    });
    const choose = h("button", { class: "quiet", onclick: () => input.click() }, icon(ICONS.upload), "Add photos");
    return h("footer", { class: "panel-foot" }, choose, input, this.finalise, this.uploadNote, this.finaliseHint);
  }

  private switch(label: string, layer: "footprint" | "track"): HTMLElement {
    const input = h("input", { type: "checkbox", checked: true, role: "switch" });
    input.addEventListener("change", () => this.actions.toggle(layer, input.checked));
    return h("label", { class: "switch" }, h("span", {}, label), input);
  }

  setMission(mission: Mission): void {
    text(this.title, mission.name);
    this.mission = mission;
    this.setSubmaps(this.hangingTogether);
    this.setProgress(mission.progress);
  }

  setSubmaps(known: Submaps): void {
    this.hangingTogether = known;
    if (!this.mission) return;
    this.notice.set(this.mission, known.maps.length);
    this.submaps.set(known, this.mission.georeferenced === false, this.colours);
  }

  setProgress(progress: Progress): void {
    const [label, tone] = progress.total || progress.state !== "open" ? STATE[progress.state] : ["Waiting", "off"];
    text(this.pill, label ?? "");
    this.pill.dataset["tone"] = tone;
    const { matched, posed, fused } = reached(progress.counts);
    const good = progress.total - progress.counts.rejected;
    text(this.headline, fused.toLocaleString("en"));
    text(this.headlineRest, `of ${count(good, "photo")} on the map`);
    text(this.stages.uploaded.value, progress.total.toLocaleString("en"));
    text(this.stages.matched.value, matched.toLocaleString("en"));
    text(this.stages.posed.value, posed.toLocaleString("en"));
    text(this.stages.fused.value, fused.toLocaleString("en"));
    text(this.stages.rejected.value, progress.counts.rejected.toLocaleString("en"));
    this.stages.rejected.root.classList.toggle("bad", progress.counts.rejected > 0);
    this.setBar(progress);
    this.setFigures(progress);
    this.setFinalise(progress, good);
    this.listExports();
  }

  private setBar({ counts, total }: Progress): void {
    const parts: [string, number][] = [
      ["fused", counts.fused], ["posed", counts.posed], ["matched", counts.matched + counts.ready + counts.received],
      ["waiting", counts.waiting], ["rejected", counts.rejected],
    ];
    this.bar.setAttribute("aria-label", parts.map(([name, n]) => `${n} ${name === "matched" ? "under way" : name}`).join(", "));
    if (!this.bar.children.length) for (const [name] of parts) this.bar.append(h("span", { class: name }));
    parts.forEach(([, n], i) => {
      const segment = this.bar.children[i];
      if (!(segment instanceof HTMLElement)) return;
      segment.style.width = total ? `${(100 * n) / total}%` : "0";
      segment.hidden = n === 0;
    });
  }

  private setFigures({ rate_per_s, latency_s, revision }: Progress): void {
    text(this.figures.rate.value, rate_per_s ? `${rate_per_s.toFixed(1)} /s` : "–");
    text(this.figures.p50.value, latency_s ? seconds(latency_s.p50) : "–");
    text(this.figures.p95.value, latency_s ? seconds(latency_s.p95) : "–");
    text(this.figures.revision.value, revision ? String(revision) : "–");
  }

  private setFinalise({ state, sharpened }: Progress, good: number): void {
    this.finalise.disabled = state !== "open" || good === 0;
    this.finalise.hidden = state === "final" || state === "sharpening";
    text(this.finaliseHint, {
      open: good ? "Finalising solves all photos together and draws the best map they give. More can still follow." : "",
      finalising: "Solving all photos together and drawing the final map…",
      sharpening: `This map is final and is being drawn at full resolution: ${Math.floor(100 * (sharpened ?? 0))}% so far.`,
      final: "This map is final. Adding photos opens it again.",
      deleting: "This mission is being deleted.",
    }[state]);
  }

  setRejected(frames: Frame[]): void {
    this.rejected.hidden = frames.length === 0;
    text(this.rejectedCount, String(frames.length));
    fill(this.rejectedList, ...frames.map((f) => h("li", {}, h("strong", {}, f.name), h("span", {}, f.reason ?? f.code ?? ""))));
  }

  setExports(exports: ExportDoc[], wanted: ReadonlySet<string>): void {
    this.exports = exports;
    this.wanted = wanted;
    this.listExports();
  }

  private listExports(): void {
    const revision = this.mission?.progress.revision ?? 0;
    const notes = this.exports.map((doc) => exportNote(doc, this.wanted.has(doc.name), revision));
    // A list that is drawn again under the pointer loses the click.
    const now = JSON.stringify([this.exports.map((doc) => [doc.name, doc.state, doc.error]), notes, revision > 0]);
    if (now === this.lastExports) return;
    this.lastExports = now;
    if (!revision) fill(this.downloads, h("li", { class: "note" }, "As soon as there is something on the map."));
    else fill(this.downloads, ...this.exports.map((doc, i) => this.download(doc, notes[i] ?? "")));
  }

  private download(doc: ExportDoc, note: string): HTMLElement {
    const [title, hint] = EXPORT_TITLES[doc.name] ?? [doc.name, ""];
    return h("li", {},
      h("button", { class: "download", disabled: this.wanted.has(doc.name), onclick: () => this.actions.download(doc) },
        h("span", { class: "name" }, title, h("small", {}, hint)), h("span", { class: "size" }, note), icon(ICONS.download),
        note === FAILED && h("span", { class: "why" }, doc.error ?? "")));
  }

  /** Which colour is which drone, and which way of posing where photos were not all posed the same way. */
  setLegend(drones: LegendEntry[], sources: LegendEntry[]): void {
    const now = JSON.stringify([drones, sources]);
    if (now === this.lastLegend) return;
    this.lastLegend = now;
    this.colours = new Map(drones);
    this.setSubmaps(this.hangingTogether);
    fill(this.drones, ...drones.map(legendEntry));
    fill(this.sources, ...sources.map(legendEntry));
  }

  setUploads(note: string): void {
    this.uploadNote.hidden = !note;
    text(this.uploadNote, note);
  }

  setConnection(up: boolean): void {
    this.offline.hidden = up;
    this.root.classList.toggle("is-offline", !up);
  }
}
