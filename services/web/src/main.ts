/** Which page is shown; links between pages keep running uploads alive. */

import "./style.css";

import { api, Problem } from "./api";
import { DocsPage } from "./docs";
import { fill, h } from "./dom";
import { MissionsPage } from "./missions";
import { Uploads } from "./uploads";

interface Page {
  destroy(): void;
}

const root = document.getElementById("app") ?? document.body;
const uploads = new Map<string, Uploads>();
let page: Page | null = null;
let visit = 0;

function uploadsOf(id: string): Uploads {
  const known = uploads.get(id) ?? new Uploads(id);
  uploads.set(id, known);
  return known;
}

function missing(message: string): void {
  fill(root, h("main", { class: "missing" }, h("h1", {}, message), h("a", { href: "/", "data-route": true, class: "quiet" }, "All missions")));
}

async function openMission(id: string): Promise<void> {
  const mine = visit;
  // The map library is the largest part by far: the list of missions does without it.
  try {
    const [{ MissionPage }, mission] = await Promise.all([import("./mission"), api.mission(id)]);
    if (mine === visit) page = new MissionPage(root, mission, uploadsOf(id));
  } catch (error) {
    if (mine !== visit) return;
    if (error instanceof Problem && error.status === 404) return missing("There is no such mission");
    missing("The server cannot be reached. Trying again…");
    setTimeout(() => mine === visit && route(), 3000);
  }
}

function route(): void {
  visit++;
  page?.destroy();
  page = null;
  const match = /^\/missions\/([^/]+)\/?$/.exec(location.pathname);
  if (match?.[1]) void openMission(decodeURIComponent(match[1]));
  else if (location.pathname === "/docs") page = new DocsPage(root);
  else page = new MissionsPage(root, (id, photos) => {
    uploadsOf(id).add(photos);
    navigate(`/missions/${id}`);
  });
}

function navigate(path: string): void {
  history.pushState(null, "", path);
  route();
}

document.addEventListener("click", (event) => {
  const link = event.target instanceof Element ? event.target.closest<HTMLAnchorElement>("a[data-route]") : null;
  if (!link || event.metaKey || event.ctrlKey || event.shiftKey || event.button !== 0) return;
  event.preventDefault();
  navigate(link.pathname);
});
window.addEventListener("popstate", route);
window.addEventListener("beforeunload", (event) => {
  if ([...uploads.values()].some((u) => u.busy)) event.preventDefault();
});
route();
