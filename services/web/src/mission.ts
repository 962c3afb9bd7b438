/** The page of one mission: the map, its panel, and the stream that keeps both up to date. */

import { api, Problem, type ExportDoc, type FramesGeoJson, type Mission, type Source } from "./api";
import { fill, h, icon, ICONS } from "./dom";
import { Live } from "./live";
import { DRONE_COLOURS, MissionMap, SOURCE_COLOURS } from "./map";
import { Panel, type LegendEntry } from "./panel";
import { dropTarget, tallyText, Uploads } from "./uploads";

const NARROW = matchMedia("(max-width: 760px)");
// How many times as long as footprints took to fetch they are left alone: a large mission's more rarely.
const FETCH_SHARE = 10;
const FETCH_EVERY_MS = 1000;

/** Runs `work` soon, never twice at once, and not more often than it can bear. */
function throttled(work: () => Promise<void>, share = FETCH_SHARE): () => void {
  let timer = 0;
  let pending = false;
  let running = false;
  let pause = 0;
  const run = async (): Promise<void> => {
    timer = 0;
    running = true;
    pending = false;
    const start = performance.now();
    await work().catch(() => undefined);
    pause = Math.max(FETCH_EVERY_MS, share * (performance.now() - start));
    running = false;
    if (pending) timer = window.setTimeout(() => void run(), pause);
  };
  return () => {
    if (running) pending = true;
    else if (!timer) timer = window.setTimeout(() => void run(), pause);
  };
}

const SOURCE_LABELS = { visual: "from the picture", gnss: "GPS and heading only", "vision-only": "picture without GPS" } as const;

/** The ways of posing in use, unless all photos were posed from the picture, as they should be. */
function sourceLegend(frames: FramesGeoJson): LegendEntry[] {
  const used = new Map<Source, number>();
  for (const { properties } of frames.features) {
    if (properties.kind === "footprint") used.set(properties.source, (used.get(properties.source) ?? 0) + 1);
  }
  if (used.size === 0 || (used.size === 1 && used.has("visual"))) return [];
  return [...used].sort().map(([source, n]) => [`${n} ${SOURCE_LABELS[source]}`, SOURCE_COLOURS[source]]);
}

function colourDrones(frames: FramesGeoJson): LegendEntry[] {
  const names = [...new Set(frames.features.map((f) => f.properties.drone))].sort();
  const colours = new Map(names.map((name, i) => [name, DRONE_COLOURS[i % DRONE_COLOURS.length] ?? "#fff"]));
  for (const feature of frames.features) Object.assign(feature.properties, { colour: colours.get(feature.properties.drone) });
  return [...colours];
}

const OFFLINE = "The server could not be reached. Try again.";
const EMPTY = ["Waiting for the first photos", "Drop photos or a folder anywhere on this page, or let the drones send them. The map grows here while they fly."] as const;
const READING = ["Reading the first photos", "They are here and safe. The map begins as soon as one of them says where it belongs."] as const;
const ALL_REJECTED = ["No photo could be used yet", "The panel says why for each of them. Others may still follow."] as const;

interface EmptyState {
  root: HTMLElement;
  title: HTMLElement;
  text: HTMLElement;
}

function emptyState(): EmptyState {
  const title = h("h2");
  const text = h("p");
  const radar = h("div", { class: "radar" }, h("i"), h("i"), h("i"), icon(ICONS.photo));
  return { root: h("div", { class: "empty", role: "status" }, radar, title, text), title, text };
}

export class MissionPage {
  private readonly panel: Panel;
  private readonly map: MissionMap;
  private readonly mapBox = h("div", { class: "map", "aria-label": "Map" });
  private readonly empty = emptyState();
  private readonly followButton: HTMLButtonElement;
  private readonly toast = h("div", { class: "toast", role: "status", hidden: true });
  private readonly undoDrop: () => void;
  private live: Live | null = null;
  private gone = false;
  private placed = false;
  private exports: ExportDoc[] = [];
  // Being asked for, and what the server has begun to make then.
  private readonly asking = new Set<string>();
  private readonly awaited = new Set<string>();
  private mission: Mission;
  private readonly refreshFrames = throttled(() => this.loadFrames());
  private readonly refreshRejected = throttled(() => this.loadRejected());
  private rejectedListed = 0;
  private submapsAsOf = -1;
  private readonly refreshSubmaps = throttled(() => this.loadSubmaps());
  private readonly refreshExports = throttled(() => this.loadExports(), 1);  // a short list, and somebody waits for it
  private readonly refreshMission = throttled(() => this.loadMission());

  constructor(root: HTMLElement, mission: Mission, private readonly uploads: Uploads) {
    this.mission = mission;
    this.panel = new Panel({
      finalise: () => void this.finalise(),
      add: (files) => uploads.add(files),
      toggle: (layer, visible) => this.map.toggle(layer, visible),
      share: () => void this.share(),
      setHeight: (height_m) => void this.setHeight(height_m),
      download: (doc) => void this.download(doc),
    });
    this.followButton = h("button", { class: "follow", hidden: true, onclick: () => this.map.follow() }, icon(ICONS.target), "Show whole map");
    fill(root, h("main", { class: "mission" }, this.mapBox, this.empty.root, this.followButton, this.panel.root, this.toast));
    this.map = new MissionMap(this.mapBox, mission.id, () => this.padding());
    this.map.onfollow = (following) => (this.followButton.hidden = following);
    this.undoDrop = dropTarget(root, (files) => uploads.add(files));
    uploads.onchange = () => this.panel.setUploads(uploads.tally.total + uploads.tally.ignored ? tallyText(uploads.tally) : "");
    uploads.onchange();
    document.title = `${mission.name} · Orthostream`;
    Object.assign(window, { missionMap: this.map });
    this.show(mission);
    this.refreshFrames();
    this.listen();
  }

  destroy(): void {
    this.gone = true;
    this.live?.close();
    this.undoDrop();
    this.uploads.onchange = () => undefined;
    this.map.destroy();
  }

  private padding(): { top: number; right: number; bottom: number; left: number } {
    if (NARROW.matches) return { top: 56, right: 24, bottom: 190, left: 24 };
    return { top: 48, right: 64, bottom: 56, left: 404 };
  }

  private show(mission: Mission): void {
    this.mission = mission;
    this.panel.setMission(mission);
    this.listRejected();
    this.listSubmaps();
    this.showEmpty();
    if (mission.zoom !== null) void this.map.showTiles(mission.zoom);
    this.refreshExports();
  }

  private listen(): void {
    this.live = new Live(this.mission.id, this.mission.event_seq, {
      tiles: (tiles) => {
        this.map.refresh(tiles);
        if (this.mission.zoom === null) this.refreshMission();
        this.refreshFrames();
      },
      frames: () => this.refreshFrames(),
      progress: (progress) => {
        const before = this.mission.progress;
        // What is georeferenced by GPS stays so; a map without GPS may move to its place with any new poses.
        const local = !this.mission.georeferenced && progress.generation !== before.generation;
        if (progress.state !== before.state || local) this.refreshMission();
        this.mission.progress = progress;
        this.panel.setMission(this.mission);
        this.listRejected();
        this.listSubmaps();
        this.showEmpty();
      },
      exports: () => this.refreshExports(),
      mission: () => this.refreshMission(),
      connection: (up) => {
        this.panel.setConnection(up);
        if (up) this.refreshMission();
      },
    });
  }

  private async loadMission(): Promise<void> {
    const mission = await api.mission(this.mission.id);
    if (!this.gone) this.show(mission);
  }

  private async loadFrames(): Promise<void> {
    const frames = await api.frames(this.mission.id);
    if (this.gone) return;
    this.panel.setLegend(colourDrones(frames), sourceLegend(frames));
    this.placed = frames.features.length > 0;
    this.showEmpty();
    // Not waited for: the pause between two fetches is measured by what the server takes.
    void this.map.showFrames(frames);
  }

  /** Against what the list shows, for a count comes with an event or with the mission's document, whichever is first. */
  private listRejected(): void {
    if (this.mission.progress.counts.rejected !== this.rejectedListed) this.refreshRejected();
  }

  private async loadRejected(): Promise<void> {
    const told = this.mission.progress.counts.rejected;
    const { frames } = await api.rejected(this.mission.id);
    if (this.gone) return;
    this.rejectedListed = told;
    this.panel.setRejected(frames);
  }

  /** Submaps change with the poses, and poses have a generation. */
  private listSubmaps(): void {
    if (this.mission.progress.generation !== this.submapsAsOf) this.refreshSubmaps();
  }

  private async loadSubmaps(): Promise<void> {
    const asOf = this.mission.progress.generation;
    const known = await api.submaps(this.mission.id);
    if (this.gone) return;
    this.submapsAsOf = asOf;
    this.panel.setSubmaps(known);
  }

  private async setHeight(height_m: number): Promise<void> {
    try {
      this.show(await api.setHeight(this.mission.id, height_m));
      this.say("Scale set");
    } catch (error) {
      this.say(error instanceof Problem ? error.message : OFFLINE);
    }
  }

  private async loadExports(): Promise<void> {
    const { exports } = await api.exports(this.mission.id);
    if (this.gone) return;
    // What somebody clicked on here and is made by now goes on by itself.
    for (const doc of exports) {
      if (doc.state === "ready" && this.awaited.delete(doc.name)) void this.download(doc);
      if (doc.state === "failed" && this.awaited.delete(doc.name)) this.say(doc.error ?? "This file could not be made.");
    }
    this.exports = exports;
    this.showExports();
  }

  private showExports(): void {
    const made = this.exports.filter((doc) => doc.state === "wanted").map((doc) => doc.name);
    this.panel.setExports(this.exports, new Set([...made, ...this.asking, ...this.awaited]));
  }

  private async download(doc: ExportDoc): Promise<void> {
    this.asking.add(doc.name);
    this.showExports();
    try {
      if ((await api.wantExport(doc)) === "wanted") this.awaited.add(doc.name);
      else h("a", { href: doc.url, download: doc.name }).click();
    } catch (error) {
      this.say(error instanceof Problem ? (doc.error ?? error.message) : OFFLINE);
    }
    this.asking.delete(doc.name);
    this.showExports();
    this.refreshExports();
  }

  private showEmpty(): void {
    const { total, counts } = this.mission.progress;
    this.empty.root.hidden = this.placed;
    const [title, text] = total === 0 ? EMPTY : total === counts.rejected ? ALL_REJECTED : READING;
    this.empty.title.textContent = title;
    this.empty.text.textContent = text;
  }

  private async finalise(): Promise<void> {
    try {
      this.show(await api.finalise(this.mission.id));
    } catch (error) {
      this.say(error instanceof Problem ? error.message : OFFLINE);
    }
  }

  private async share(): Promise<void> {
    try {
      await navigator.clipboard.writeText(location.href);
      this.say("Link copied");
    } catch {
      this.say(location.href);
    }
  }

  private say(message: string): void {
    this.toast.textContent = message;
    this.toast.hidden = false;
    setTimeout(() => (this.toast.hidden = true), 4000);
  }
}
