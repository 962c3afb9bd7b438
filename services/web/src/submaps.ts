/** The panel's section on what hangs together: submaps, what places each, and the ties between them. */

import type { SubmapOut, Submaps, TieOut } from "./api";
import { fill, h, text } from "./dom";
import { count } from "./format";

// More than these are counted, not listed: a flight over woods can fall into dozens of crumbs.
const LISTED = 8;
const PLACED_BY = { gps: "by GPS", tie: "by a tie", none: "waits for a tie" } as const;
const LOCAL = "not georeferenced";

export class SubmapsSection {
  readonly root = h("details", { class: "section submaps", hidden: true });
  private readonly badge = h("span", { class: "badge calm" });
  private readonly list = h("ul", { class: "rows" });
  private readonly ties = h("ul", { class: "rows" });
  private readonly tiesTitle = h("h3", {}, "Ties");
  private last = "";

  constructor() {
    const hint = "A submap is a part of one drone's flight whose photos hang together. Ties merge submaps into one map.";
    this.root.append(h("summary", { title: hint }, "Submaps", this.badge), this.list, this.tiesTitle, this.ties);
  }

  set(known: Submaps, local: boolean, colours: ReadonlyMap<string, string>): void {
    // Drawn again only when it changed, so that nothing moves under the pointer.
    const now = JSON.stringify([known.submaps, known.ties, local, [...colours]]);
    if (now === this.last) return;
    this.last = now;
    const large = known.submaps.filter((s) => s.frames > 1);
    this.root.hidden = known.submaps.length === 0;
    text(this.badge, String(large.length || known.submaps.length));
    const crumbs = [...large.slice(LISTED), ...known.submaps.filter((s) => s.frames === 1)];
    fill(this.list, ...large.slice(0, LISTED).map((s) => row(s, local, colours)), crumbs.length > 0 && rest(crumbs));
    const ties = [...known.ties].sort((a, b) => Number(b.accepted) - Number(a.accepted) || b.strength - a.strength);
    this.tiesTitle.hidden = ties.length === 0;
    fill(this.ties, ...ties.slice(0, LISTED).map(tie), ties.length > LISTED && h("li", { class: "note" }, `and ${count(ties.length - LISTED, "weaker tie")}`));
  }
}

function row(s: SubmapOut, local: boolean, colours: ReadonlyMap<string, string>): HTMLElement {
  const dot = h("i");
  dot.style.background = colours.get(s.drone) ?? "var(--muted)";
  const waits = s.georeferenced_by === "none" && !local;
  const placed = local && s.georeferenced_by === "none" ? LOCAL : PLACED_BY[s.georeferenced_by];
  return h("li", { class: waits ? "waits" : "" },
    h("b", {}, String(s.index + 1)), dot, h("span", { class: "name" }, s.drone), h("span", {}, count(s.frames, "photo")), h("span", { class: "how" }, placed));
}

function rest(crumbs: SubmapOut[]): HTMLElement {
  const photos = crumbs.reduce((sum, s) => sum + s.frames, 0);
  return h("li", { class: "note" }, `and ${count(photos, "photo")} in ${count(crumbs.length, "smaller submap")}`);
}

function tie(t: TieOut): HTMLElement {
  const hint = `Strength C = F + 0.1 M + 0.1 θ²: ${t.frames} photos, ${t.points} points, ${t.angle_deg.toFixed(1)}°`;
  return h("li", { class: t.accepted ? "" : "muted", title: hint },
    h("b", {}, `${t.low + 1} – ${t.high + 1}`), h("span", { class: "name" }, `strength ${t.strength.toFixed(0)}`),
    h("span", {}, count(t.frames, "photo")), h("span", { class: "how" }, t.accepted ? "holds them together" : "spare"));
}
