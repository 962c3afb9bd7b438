/** The API's reference, drawn from its own OpenAPI document: nothing is written twice, nothing comes from elsewhere. */

import { fill, h } from "./dom";

interface Schema {
  $ref?: string;
  type?: string;
  enum?: string[];
  anyOf?: Schema[];
  items?: Schema;
  properties?: Record<string, Schema>;
  description?: string;
  format?: string;
}

interface Parameter {
  name: string;
  in: string;
  required?: boolean;
  description?: string;
  schema?: Schema;
}

interface Operation {
  tags?: string[];
  summary?: string;
  description?: string;
  parameters?: Parameter[];
  requestBody?: { content: Record<string, { schema?: Schema }> };
  responses: Record<string, { description: string; content?: Record<string, { schema?: Schema }> }>;
}

interface OpenApi {
  info: { title: string; version: string; description: string };
  paths: Record<string, Record<string, Operation>>;
  components: { schemas: Record<string, Schema> };
}

const DOCUMENT = "/api/v1/openapi.json";

/** A schema in a few words: `string`, `integer or null`, `list of FrameOut`. */
function typeName(schema: Schema | undefined): string {
  if (!schema) return "";
  if (schema.$ref) return schema.$ref.split("/").pop() ?? "";
  if (schema.anyOf) return schema.anyOf.map(typeName).join(" or ");
  if (schema.enum) return schema.enum.join(" | ");
  if (schema.items) return `list of ${typeName(schema.items)}`;
  return schema.format === "binary" ? "file" : (schema.type ?? "any");
}

/** `code` between backticks, the rest as it is. */
function prose(text: string): HTMLElement {
  const parts = text.split("`").map((part, i) => (i % 2 ? h("code", {}, part) : part));
  return h("p", {}, ...parts);
}

function fields(schema: Schema | undefined, document: OpenApi): HTMLElement | null {
  const name = schema?.$ref ? typeName(schema) : "";
  const known = (name ? document.components.schemas[name] : schema)?.properties;
  if (!known) return null;
  return table(Object.entries(known).map(([key, value]) => [key, typeName(value), value.description ?? ""]));
}

function table(rows: [name: string, type: string, text: string][]): HTMLElement {
  return h("table", {}, ...rows.map(([name, type, text]) =>
    h("tr", {}, h("td", {}, h("code", {}, name)), h("td", { class: "type" }, type), h("td", {}, text))));
}

function curl(method: string, path: string, operation: Operation): string {
  const url = `${location.origin}${path}`;
  const body = operation.requestBody?.content ?? {};
  const verb = method === "get" ? "" : ` -X ${method.toUpperCase()}`;
  if (body["multipart/form-data"]) return `curl${verb} ${url} -F files=@photo.jpg`;
  if (body["application/json"]) return `curl${verb} ${url} -H 'content-type: application/json' -d '{"name": "River bank east"}'`;
  return `curl${verb}${path.endsWith("/events") ? " -N" : ""} ${url}`;
}

function operationCard(method: string, path: string, operation: Operation, document: OpenApi): HTMLElement {
  const parameters = (operation.parameters ?? []).map((p): [string, string, string] =>
    [p.name, `${typeName(p.schema)}${p.required ? "" : ", optional"}`, p.description ?? p.in]);
  const body = Object.values(operation.requestBody?.content ?? {})[0]?.schema;
  const answers = Object.entries(operation.responses).map(([status, { description, content }]): [string, string, string] =>
    [status, typeName(Object.values(content ?? {})[0]?.schema), description]);
  const answer = Object.values(operation.responses["200"]?.content ?? operation.responses["201"]?.content ?? {})[0]?.schema;
  const shape = fields(answer, document);
  return h("details", { class: "operation" },
    h("summary", {}, h("b", { class: method }, method.toUpperCase()), h("code", {}, path), h("span", {}, operation.summary ?? "")),
    h("div", {},
      operation.description ? prose(operation.description) : null,
      h("pre", {}, curl(method, path, operation)),
      parameters.length > 0 && h("h4", {}, "Parameters"), parameters.length > 0 && table(parameters),
      body && h("h4", {}, "Body"), body && fields(body, document),
      h("h4", {}, "Answers"), table(answers),
      shape && h("h4", {}, typeName(answer)), shape));
}

export class DocsPage {
  constructor(root: HTMLElement) {
    const list = h("div", { class: "operations" });
    fill(root, h("main", { class: "home" },
      h("header", { class: "home-head" }, h("a", { class: "brand", href: "/", "data-route": true }, h("i", { class: "mark" }), "Orthostream"),
        h("a", { class: "docs", href: DOCUMENT }, "openapi.json")),
      h("h1", { class: "docs-title" }, "API"), list));
    document.title = "API · Orthostream";
    void this.load(list);
  }

  destroy(): void {
    // Nothing runs on after the first load.
  }

  private async load(list: HTMLElement): Promise<void> {
    const reference = (await (await fetch(DOCUMENT)).json()) as OpenApi;
    const byTag = new Map<string, HTMLElement[]>();
    for (const [path, operations] of Object.entries(reference.paths)) {
      for (const [method, operation] of Object.entries(operations)) {
        const tag = operation.tags?.[0] ?? "other";
        byTag.set(tag, [...(byTag.get(tag) ?? []), operationCard(method, path, operation, reference)]);
      }
    }
    fill(list, ...[...byTag].map(([tag, cards]) => h("section", {}, h("h2", {}, tag), ...cards)));
  }
}
