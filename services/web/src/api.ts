/** The HTTP API as the page sees it: types of its documents and one typed fetch. */

export type FrameState = "received" | "ready" | "matched" | "posed" | "fused" | "waiting" | "rejected";
export type MissionState = "open" | "finalising" | "sharpening" | "final" | "deleting";
export type Source = "visual" | "gnss" | "vision-only";
export type Counts = Record<FrameState, number>;

export interface Progress {
  state: MissionState;
  counts: Counts;
  total: number;
  revision: number;
  generation: number;
  tiles: number;
  dirty_tiles: number;
  rate_per_s: number | null;
  latency_s: { p50: number; p95: number } | null;
  reprojection_rms_px: number | null;
  sharpened: number | null;
}

export interface Scale {
  first_height_m: number | null;
  marker: { photo: string; length_m: number } | null;
}

export interface SubmapOut {
  index: number;
  submap: number | null;
  frames: number;
  drone: string;
  georeferenced_by: "gps" | "tie" | "none";
}

export interface TieOut {
  low: number;
  high: number;
  strength: number;
  frames: number;
  points: number;
  angle_deg: number;
  accepted: boolean;
}

export interface Submaps {
  maps: { submap: number; frames: number }[];
  submaps: SubmapOut[];
  ties: TieOut[];
}

export interface Mission {
  id: string;
  name: string;
  mode: string;
  state: MissionState;
  created_at: number;
  zoom: number | null;
  scale: Scale | null;
  georeferenced: boolean | null;
  event_seq: number;
  progress: Progress;
}

export interface MissionPage {
  missions: Mission[];
  next: string | null;
}

export interface Frame {
  frame_id: string;
  name: string;
  state: FrameState;
  code: string | null;
  reason: string | null;
}

export interface FramePage {
  frames: Frame[];
  next: string | null;
}

export interface ExportDoc {
  name: string;
  state: "available" | "wanted" | "ready" | "failed";
  size_bytes: number | null;
  revision: number | null;
  error: string | null;
  url: string;
}

export interface UploadResult {
  name: string;
  frame_id: string | null;
  state: FrameState;
  created: boolean;
  code?: string;
  detail?: string;
}

interface FootprintProperties {
  kind: "footprint";
  name: string;
  drone: string;
  state: FrameState;
  source: Source;
}

interface TrackProperties {
  kind: "track";
  drone: string;
}

interface CameraProperties {
  kind: "camera";
  name: string;
  drone: string;
  state: FrameState;
}

export type FramesGeoJson = GeoJSON.FeatureCollection<
  GeoJSON.Polygon | GeoJSON.LineString | GeoJSON.Point,
  FootprintProperties | TrackProperties | CameraProperties
>;

/** A refusal by the API, with the sentence that it gave. */
export class Problem extends Error {
  constructor(
    readonly status: number,
    readonly code: string,
    detail: string,
    readonly errors: UploadResult[] = [],
  ) {
    super(detail);
  }
}

const BASE = "/api/v1";

export function missionUrl(id: string, rest = ""): string {
  return `${BASE}/missions/${encodeURIComponent(id)}${rest}`;
}

async function problem(response: Response): Promise<Problem> {
  try {
    const body = (await response.json()) as { code?: string; detail?: string; errors?: UploadResult[] };
    return new Problem(response.status, body.code ?? "error", body.detail ?? response.statusText, body.errors);
  } catch {
    return new Problem(response.status, "error", `The server answered ${response.status}.`);
  }
}

async function request<T>(url: string, init?: RequestInit): Promise<T> {
  const response = await fetch(url, init);
  if (!response.ok) throw await problem(response);
  return (response.status === 204 ? undefined : await response.json()) as T;
}

export const api = {
  missions: (after?: string | null): Promise<MissionPage> =>
    request(`${BASE}/missions?limit=50${after ? `&after=${encodeURIComponent(after)}` : ""}`),
  create: (name: string): Promise<Mission> =>
    request(`${BASE}/missions`, {
      method: "POST",
      headers: { "content-type": "application/json" },
      body: JSON.stringify({ name }),
    }),
  mission: (id: string): Promise<Mission> => request(missionUrl(id)),
  finalise: (id: string): Promise<Mission> => request(missionUrl(id, "/finalise"), { method: "POST" }),
  setHeight: (id: string, first_height_m: number): Promise<Mission> =>
    request(missionUrl(id, "/scale"), {
      method: "PUT",
      headers: { "content-type": "application/json" },
      body: JSON.stringify({ first_height_m }),
    }),
  submaps: (id: string): Promise<Submaps> => request(missionUrl(id, "/submaps")),
  frames: (id: string): Promise<FramesGeoJson> => request(missionUrl(id, "/frames.geojson")),
  rejected: (id: string): Promise<FramePage> => request(missionUrl(id, "/frames?state=rejected&limit=200")),
  exports: (id: string): Promise<{ exports: ExportDoc[] }> => request(missionUrl(id, "/exports")),
  /** 200 when it is ready; 202 has it made, and an `export` event says when it is. */
  wantExport: async (doc: ExportDoc): Promise<"ready" | "wanted"> => {
    const response = await fetch(doc.state === "failed" ? `${doc.url}?retry=true` : doc.url, { method: "HEAD" });
    if (!response.ok) throw new Problem(response.status, "export_failed", "This file could not be made.");
    return response.status === 202 ? "wanted" : "ready";
  },
  upload: (id: string, file: File, signal: AbortSignal): Promise<{ frames: UploadResult[] }> => {
    const form = new FormData();
    form.append("files", file, file.name);
    return request(missionUrl(id, "/frames"), { method: "POST", body: form, signal });
  },
};
