/** The map: tiles that refresh as they change, footprints, flight tracks; it follows until somebody moves it. */

import {
  LngLatBounds,
  Map as MapLibre,
  NavigationControl,
  ScaleControl,
  setWorkerUrl,
  type ExpressionSpecification,
  type GeoJSONSource,
  type MapSourceDataEvent,
  type StyleSpecification,
} from "maplibre-gl";
import "maplibre-gl/dist/maplibre-gl.css";
import workerUrl from "maplibre-gl/dist/maplibre-gl-worker.mjs?worker&url";

import { missionUrl, type FramesGeoJson } from "./api";
import type { Tile } from "./live";

setWorkerUrl(workerUrl);

export const DRONE_COLOURS = ["#63c5ea", "#f2a33a", "#a78bfa", "#5fd09b", "#f47ca0", "#e2d260", "#7fa7ff", "#e58a5e"];
const EMPTY: FramesGeoJson = { type: "FeatureCollection", features: [] };
const OVERDUE_MS = 10_000;
const BACKGROUND = "#14181a";

export const SOURCE_COLOURS = { visual: "#e8f1f4", gnss: "#ff8f6b", "vision-only": "#c9a6ff" } as const;
const SOURCE_COLOUR: ExpressionSpecification = [
  "match", ["get", "source"],
  "gnss", SOURCE_COLOURS.gnss, "vision-only", SOURCE_COLOURS["vision-only"], SOURCE_COLOURS.visual,
];
// A photo whose pixels are on the map already needs no more than a thin outline.
const WAITING: ExpressionSpecification = ["!=", ["get", "state"], "fused"];

function style(): StyleSpecification {
  const only = (kind: string): ExpressionSpecification => ["==", ["get", "kind"], kind];
  const drone: ExpressionSpecification = ["coalesce", ["get", "colour"], DRONE_COLOURS[0] ?? "#fff"];
  return {
    version: 8,
    sources: { frames: { type: "geojson", data: EMPTY } },
    layers: [
      { id: "background", type: "background", paint: { "background-color": BACKGROUND } },
      {
        id: "footprint-fill", type: "fill", source: "frames", filter: only("footprint"),
        paint: { "fill-color": SOURCE_COLOUR, "fill-opacity": ["case", WAITING, 0.06, 0] },
      },
      {
        id: "footprint-line", type: "line", source: "frames", filter: only("footprint"),
        paint: {
          "line-color": SOURCE_COLOUR,
          "line-width": ["case", WAITING, 1.4, 0.8],
          "line-opacity": ["case", WAITING, 0.9, 0.26],
        },
      },
      {
        id: "track-casing", type: "line", source: "frames", filter: only("track"),
        layout: { "line-join": "round", "line-cap": "round" },
        paint: { "line-color": "#0b0d0e", "line-width": 4, "line-opacity": 0.5 },
      },
      {
        id: "track-line", type: "line", source: "frames", filter: only("track"),
        layout: { "line-join": "round", "line-cap": "round" },
        paint: { "line-color": drone, "line-width": 1.8 },
      },
      {
        id: "track-points", type: "circle", source: "frames", filter: only("camera"),
        paint: {
          "circle-radius": ["case", ["get", "head"], 5.5, 2.2],
          "circle-color": drone,
          "circle-stroke-color": ["case", ["get", "head"], "#ffffff", "#0b0d0e"],
          "circle-stroke-width": ["case", ["get", "head"], 2, 0.8],
        },
      },
    ],
  };
}

/** What an error of the library says of the tile that it is about. */
interface BrokenTile {
  tileID: { canonical: { z: number; x: number; y: number } };
}

const key = (z: number, x: number, y: number): string => `${z}/${x}/${y}`;

export class MissionMap {
  onfollow: (following: boolean) => void = () => undefined;
  private readonly map: MapLibre;
  private readonly loaded: Promise<void>;
  private following = true;
  private extent: LngLatBounds | null = null;
  private zoom: number | null = null;
  private tick = 0;
  private frameRequest = 0;
  private readonly changed = new Map<string, Tile>();
  private readonly changedAt = new Map<string, number>();
  private readonly requestedAt = new Map<string, number>();
  private readonly underWay = new Map<string, number>();
  private readonly broken = new Set<string>();

  constructor(
    container: HTMLElement,
    private readonly missionId: string,
    private readonly padding: () => { top: number; right: number; bottom: number; left: number },
  ) {
    this.map = new MapLibre({
      container,
      style: style(),
      center: [0, 20],
      zoom: 1.2,
      attributionControl: false,
      dragRotate: true,
      // A tile out of view is asked for again when it comes back (a 304 when nothing changed): a copy
      // kept aside would be shown stale, because only tiles in view are refreshed.
      maxTileCacheSize: 0,
      fadeDuration: 0,
      transformRequest: (url) => this.stamp(url),
    });
    this.map.addControl(new NavigationControl({ visualizePitch: false }), "top-right");
    this.map.addControl(new ScaleControl({ maxWidth: 120, unit: "metric" }), "bottom-right");
    this.map.on("movestart", (event) => {
      if ("originalEvent" in event && event.originalEvent) this.setFollowing(false);
    });
    // A tile that the server could not send is asked for again with the next change; nobody needs the console.
    this.map.on("error", (event) => {
      console.warn(event.error.message);
      const id = (event as { tile?: BrokenTile }).tile?.tileID.canonical;
      if (id) this.broken.add(key(id.z, id.x, id.y));
    });
    this.map.on("sourcedata", (event) => this.recheck(event));
    this.loaded = new Promise((resolve) => void this.map.once("load", () => resolve()));
  }

  destroy(): void {
    cancelAnimationFrame(this.frameRequest);
    this.map.remove();
  }

  /** For tests and the console: the tiles' layer is there and everything in view has arrived. */
  get settled(): boolean {
    return this.zoom !== null && this.map.loaded() && this.map.areTilesLoaded();
  }

  async showTiles(zoom: number): Promise<void> {
    await this.loaded;
    if (this.zoom === zoom) return;
    this.zoom = zoom;
    if (this.map.getLayer("tiles")) this.map.removeLayer("tiles");
    if (this.map.getSource("tiles")) this.map.removeSource("tiles");
    this.map.addSource("tiles", {
      type: "raster",
      tiles: [`${location.origin}${missionUrl(this.missionId, "/tiles/{z}/{x}/{y}")}`],
      tileSize: 512,
      maxzoom: zoom,
    });
    this.map.addLayer(
      { id: "tiles", type: "raster", source: "tiles", paint: { "raster-fade-duration": 120, "raster-resampling": "linear" } },
      "footprint-fill",
    );
    this.map.setMaxZoom(Math.min(zoom + 3, 25));
  }

  /** Tiles that the server published again: those in view are fetched anew, once per animation frame. */
  refresh(tiles: Tile[]): void {
    this.tick++;
    for (const tile of tiles) {
      this.changed.set(key(...tile), tile);
      this.changedAt.set(key(...tile), this.tick);
    }
    if (!this.frameRequest) this.frameRequest = requestAnimationFrame(() => this.flush());
  }

  async showFrames(frames: FramesGeoJson): Promise<void> {
    await this.loaded;
    await this.map.getSource<GeoJSONSource>("frames")?.setData(frames);
    const extent = extentOf(frames);
    const grown = extent && (!this.extent || !contains(this.extent, extent));
    this.extent = extent ?? this.extent;
    if (grown && this.following) this.fit();
  }

  toggle(layer: "footprint" | "track", visible: boolean): void {
    void this.loaded.then(() => {
      for (const id of this.map.getLayersOrder().filter((name) => name.startsWith(layer))) {
        this.map.setLayoutProperty(id, "visibility", visible ? "visible" : "none");
      }
    });
  }

  follow(): void {
    this.setFollowing(true);
    this.fit();
  }

  private fit(): void {
    if (!this.extent) return;
    this.map.fitBounds(this.extent, {
      padding: this.padding(),
      maxZoom: this.zoom ?? 19,
      duration: this.map.getZoom() < 5 ? 0 : 700,
    });
  }

  private setFollowing(following: boolean): void {
    if (this.following === following) return;
    this.following = following;
    this.onfollow(following);
  }

  private flush(): void {
    this.frameRequest = 0;
    const overdue = performance.now() - OVERDUE_MS;
    const now = [...this.changed].filter(([name]) => (this.underWay.get(name) ?? -Infinity) <= overdue);
    this.changed.clear();
    // The library draws a tile that never had a picture when it is refreshed, and stumbles: begin afresh.
    if (this.zoom !== null && now.some(([name]) => this.broken.has(name))) return this.begin(this.zoom);
    const tiles = now.map(([, [z, x, y]]) => ({ z, x, y }));
    if (tiles.length && this.map.getSource("tiles")) this.map.refreshTiles("tiles", tiles);
  }

  private begin(zoom: number): void {
    this.broken.clear();
    this.underWay.clear();
    this.zoom = null;
    void this.showTiles(zoom);
  }

  private stamp(url: string): undefined {
    const match = /\/tiles\/(\d+\/\d+\/\d+)$/.exec(url);
    if (match?.[1]) {
      this.requestedAt.set(match[1], this.tick);
      this.underWay.set(match[1], performance.now());
    }
    return undefined;
  }

  // A tile that changed while its request was under way may have got the old picture, and two requests
  // at once may land in either order: it is asked for again, once, when the first answer is there.
  private recheck(event: MapSourceDataEvent): void {
    const id = event.sourceId === "tiles" ? event.coord?.canonical : undefined;
    if (!id) return;
    const name = key(id.z, id.x, id.y);
    this.underWay.delete(name);
    if (event.tile?.state === "loaded") this.broken.delete(name);
    if ((this.changedAt.get(name) ?? 0) > (this.requestedAt.get(name) ?? 0)) this.refresh([[id.z, id.x, id.y]]);
  }
}

function extentOf(frames: FramesGeoJson): LngLatBounds | null {
  const bounds = new LngLatBounds();
  for (const { geometry } of frames.features) {
    if (geometry.type === "Point") bounds.extend(geometry.coordinates as [number, number]);
    if (geometry.type === "Polygon") for (const c of geometry.coordinates[0] ?? []) bounds.extend(c as [number, number]);
  }
  return bounds.isEmpty() ? null : bounds;
}

function contains(outer: LngLatBounds, inner: LngLatBounds): boolean {
  return outer.contains(inner.getSouthWest()) && outer.contains(inner.getNorthEast());
}
