/** The page of one mission: the map, its panel, and the stream that keeps both up to date. */

import { api, Problem, type FramesGeoJson, type Mission } from "./api";
import { fill, h, icon, ICONS } from "./dom";
import { Live } from "./live";
import { DRONE_COLOURS, MissionMap } from "./map";
import { Panel } from "./panel";
import { dropTarget, tallyText, Uploads } from "./uploads";

const NARROW = matchMedia("(max-width: 760px)");
// How much of the time footprints may take to fetch: a large mission refreshes them more rarely.
const FETCH_SHARE = 10;
const FETCH_EVERY_MS = 1000;

/** Runs `work` soon, never twice at once, and not more often than it can bear. */
function throttled(work: () => Promise<void>): () => void {
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
    pause = Math.max(FETCH_EVERY_MS, FETCH_SHARE * (performance.now() - start));
    running = false;
    if (pending) timer = window.setTimeout(() => void run(), pause);
  };
  return () => {
    if (running) pending = true;
    else if (!timer) timer = window.setTimeout(() => void run(), pause);
  };
}

function colourDrones(frames: FramesGeoJson): [string, string][] {
  const names = [...new Set(frames.features.map((f) => f.properties.drone))].sort();
  const colours = new Map(names.map((name, i) => [name, DRONE_COLOURS[i % DRONE_COLOURS.length] ?? "#fff"]));
  for (const feature of frames.features) Object.assign(feature.properties, { colour: colours.get(feature.properties.drone) });
  return [...colours];
}

function emptyState(): HTMLElement {
  return h("div", { class: "empty", role: "status" },
    h("div", { class: "radar" }, h("i"), h("i"), h("i"), icon(ICONS.photo)),
    h("h2", {}, "Waiting for the first photos"),
    h("p", {}, "Drop photos or a folder anywhere on this page, or let the drones send them. The map grows here while they fly."));
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
  private mission: Mission;
  private readonly refreshFrames = throttled(() => this.loadFrames());
  private readonly refreshRejected = throttled(() => this.loadRejected());
  private readonly refreshMission = throttled(() => this.loadMission());

  constructor(root: HTMLElement, mission: Mission, private readonly uploads: Uploads) {
    this.mission = mission;
    this.panel = new Panel(mission.id, {
      finalise: () => void this.finalise(),
      add: (files) => uploads.add(files),
      toggle: (layer, visible) => this.map.toggle(layer, visible),
      share: () => void this.share(),
    });
    this.followButton = h("button", { class: "follow", hidden: true, onclick: () => this.map.follow() }, icon(ICONS.target), "Show whole map");
    fill(root, h("main", { class: "mission" }, this.mapBox, this.empty, this.followButton, this.panel.root, this.toast));
    this.map = new MissionMap(this.mapBox, mission.id, () => this.padding());
    this.map.onfollow = (following) => (this.followButton.hidden = following);
    this.undoDrop = dropTarget(root, (files) => uploads.add(files));
    uploads.onchange = () => this.panel.setUploads(uploads.tally.total + uploads.tally.ignored ? tallyText(uploads.tally) : "");
    uploads.onchange();
    document.title = `${mission.name} · Orthostream`;
    Object.assign(window, { missionMap: this.map });
    this.show(mission);
    this.refreshFrames();
    this.refreshRejected();
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
    this.empty.hidden = mission.progress.total > 0;
    if (mission.zoom !== null) void this.map.showTiles(mission.zoom);
    void this.loadExports();
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
        const rejected = this.mission.progress.counts.rejected !== progress.counts.rejected;
        if (progress.state !== this.mission.progress.state) this.refreshMission();
        this.mission.progress = progress;
        this.panel.setProgress(progress);
        this.empty.hidden = progress.total > 0;
        if (rejected) this.refreshRejected();
      },
      exports: () => void this.loadExports(),
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
    this.panel.setDrones(colourDrones(frames));
    await this.map.showFrames(frames);
  }

  private async loadRejected(): Promise<void> {
    const { frames } = await api.rejected(this.mission.id);
    if (!this.gone) this.panel.setRejected(frames);
  }

  private async loadExports(): Promise<void> {
    const { exports } = await api.exports(this.mission.id);
    if (!this.gone) this.panel.setExports(exports, this.mission.progress.state);
  }

  private async finalise(): Promise<void> {
    try {
      this.show(await api.finalise(this.mission.id));
    } catch (error) {
      this.say(error instanceof Problem ? error.message : "The server could not be reached. Try again.");
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
