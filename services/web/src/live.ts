/** The mission's event stream: resumes where it broke off, says when it is broken. */

import { missionUrl, type Progress } from "./api";

export type Tile = [z: number, x: number, y: number];

export interface LiveHandlers {
  tiles(changed: Tile[], revision: number): void;
  frames(): void;
  progress(progress: Progress): void;
  exports(): void;
  mission(): void;
  connection(up: boolean): void;
}

const RETRY_MS = [1000, 2000, 4000, 8000];
// A stream that says nothing for this long is dead even if the socket does not know: the server's
// heartbeat is every 10 s.
const SILENCE_MS = 25_000;

export class Live {
  private source: EventSource | null = null;
  private failures = 0;
  private retryTimer = 0;
  private silenceTimer = 0;
  private closed = false;

  constructor(
    private readonly missionId: string,
    private lastSeq: number,
    private readonly handlers: LiveHandlers,
  ) {
    this.open();
  }

  close(): void {
    this.closed = true;
    this.drop();
    clearTimeout(this.retryTimer);
  }

  private drop(): void {
    this.source?.close();
    this.source = null;
    clearTimeout(this.silenceTimer);
  }

  private open(): void {
    const source = new EventSource(missionUrl(this.missionId, `/events?after=${this.lastSeq}`));
    this.source = source;
    source.onopen = () => {
      this.failures = 0;
      this.heard();
      this.handlers.connection(true);
    };
    // The browser's own reconnection gives up on some errors and never looks at silence: ours does both.
    source.onerror = () => this.lost();
    this.listen(source);
  }

  private listen(source: EventSource): void {
    const on = (kind: string, handle: (payload: unknown) => void): void => {
      source.addEventListener(kind, (event: MessageEvent<string>) => {
        this.heard();
        if (event.lastEventId) this.lastSeq = Number(event.lastEventId);
        handle(JSON.parse(event.data));
      });
    };
    on("tiles", (payload) => {
      const { tiles, revision } = payload as { tiles: Tile[]; revision: number };
      this.handlers.tiles(tiles, revision);
    });
    on("frame", () => this.handlers.frames());
    on("progress", (payload) => this.handlers.progress(payload as Progress));
    on("export", () => this.handlers.exports());
    on("mission", () => this.handlers.mission());
    on("heartbeat", () => undefined);
  }

  private heard(): void {
    clearTimeout(this.silenceTimer);
    this.silenceTimer = window.setTimeout(() => this.lost(), SILENCE_MS);
  }

  private lost(): void {
    if (this.closed) return;
    this.drop();
    this.handlers.connection(false);
    const wait = RETRY_MS[Math.min(this.failures++, RETRY_MS.length - 1)] ?? 8000;
    clearTimeout(this.retryTimer);
    this.retryTimer = window.setTimeout(() => this.open(), wait);
  }
}
