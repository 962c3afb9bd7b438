/** Photos from the browser: one request a photo, a few at a time, again and again until the network lets them through. */

import { api, Problem } from "./api";

export interface UploadTally {
  total: number;
  done: number;
  again: number;
  refused: number;
  ignored: number;
  waiting: boolean;
}

const PARALLEL = 4;
const PHOTO = /\.(jpe?g|tiff?|mpo)$/i;
const BACKOFF_MS = 1500;
const LONGEST_BACKOFF_MS = 20_000;

const sleep = (ms: number): Promise<void> => new Promise((resolve) => setTimeout(resolve, ms));

export class Uploads {
  readonly tally: UploadTally = { total: 0, done: 0, again: 0, refused: 0, ignored: 0, waiting: false };
  onchange: () => void = () => undefined;
  private queue: File[] = [];
  private running = 0;
  private readonly abort = new AbortController();

  constructor(private readonly missionId: string) {}

  get busy(): boolean {
    return this.running > 0 || this.queue.length > 0;
  }

  add(files: File[]): void {
    const photos = files.filter((file) => PHOTO.test(file.name));
    // In the order they were taken, as far as names tell, so that the map grows along the flight.
    photos.sort((a, b) => a.name.localeCompare(b.name, "en", { numeric: true }));
    this.tally.ignored += files.length - photos.length;
    this.tally.total += photos.length;
    this.queue.push(...photos);
    this.onchange();
    while (this.running < PARALLEL && this.queue.length) void this.work();
  }

  private async work(): Promise<void> {
    this.running++;
    for (let file = this.queue.shift(); file; file = this.queue.shift()) {
      await this.send(file);
      this.onchange();
    }
    this.running--;
    this.onchange();
  }

  private async send(file: File): Promise<void> {
    for (let attempt = 0; ; attempt++) {
      try {
        const { frames } = await api.upload(this.missionId, file, this.abort.signal);
        this.tally.waiting = false;
        this.tally.done++;
        if (frames[0] && !frames[0].created) this.tally.again++;
        return;
      } catch (error) {
        if (error instanceof Problem && error.status < 500 && error.status !== 429 && error.status !== 408) {
          this.tally.refused++;
          return;
        }
        this.tally.waiting = true;
        this.onchange();
        await sleep(Math.min(BACKOFF_MS * 2 ** attempt, LONGEST_BACKOFF_MS));
      }
    }
  }
}

async function entryFiles(entry: FileSystemEntry): Promise<File[]> {
  if (entry.isFile) {
    return [await new Promise<File>((resolve, reject) => (entry as FileSystemFileEntry).file(resolve, reject))];
  }
  const reader = (entry as FileSystemDirectoryEntry).createReader();
  const files: File[] = [];
  // readEntries gives at most 100 at a time and an empty list at the end.
  for (;;) {
    const batch = await new Promise<FileSystemEntry[]>((resolve, reject) => reader.readEntries(resolve, reject));
    if (!batch.length) return files;
    for (const child of batch) files.push(...(await entryFiles(child)));
  }
}

async function droppedFiles(transfer: DataTransfer): Promise<File[]> {
  // Entries must be taken before the first await: the transfer is emptied when the event handler returns.
  const entries = [...transfer.items].map((item) => item.webkitGetAsEntry()).filter((entry) => entry !== null);
  if (!entries.length) return [...transfer.files];
  return (await Promise.all(entries.map(entryFiles))).flat();
}

/** Makes a whole element a place to drop photos and folders on; returns what undoes it. */
export function dropTarget(element: HTMLElement, receive: (files: File[]) => void): () => void {
  const controller = new AbortController();
  const { signal } = controller;
  let depth = 0;
  const show = (on: boolean): void => void element.classList.toggle("dropping", on);
  element.addEventListener("dragenter", (event) => {
    event.preventDefault();
    if (++depth === 1) show(true);
  }, { signal });
  element.addEventListener("dragover", (event) => event.preventDefault(), { signal });
  element.addEventListener("dragleave", () => {
    if (--depth <= 0) show(false);
  }, { signal });
  element.addEventListener("drop", (event) => {
    event.preventDefault();
    depth = 0;
    show(false);
    if (event.dataTransfer) void droppedFiles(event.dataTransfer).then(receive);
  }, { signal });
  return () => controller.abort();
}

/** One tally as a sentence. */
export function tallyText(tally: UploadTally): string {
  const parts = [`${tally.done + tally.refused} of ${tally.total} sent`];
  if (tally.again) parts.push(`${tally.again} were already here`);
  if (tally.refused) parts.push(`${tally.refused} refused`);
  if (tally.ignored) parts.push(`${tally.ignored} not photos, left out`);
  if (tally.waiting) parts.push("waiting for the network");
  return parts.join(" · ");
}
