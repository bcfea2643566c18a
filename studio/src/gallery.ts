// The results on this machine: pictures, tables, reports, and stacks that can be opened.

import { get, post, told } from "./api";
import { button, byId, el } from "./dom";
import type { Shape, StackFacts, StacksFile } from "./types";

interface Item {
  id: string;
  kind: "stacks" | "picture" | "table" | "report" | "page";
  name: string;
  folder: string;
}

const MOST_OPENED = 12;
const FACES = { stacks: "▦", table: "☰", report: "¶", page: "◧", picture: "" };

export class Gallery {
  private readonly list = byId("gallery");
  private readonly dialog = byId<HTMLDialogElement>("item");

  /** @param open Shows stacks in the studio. */
  constructor(private readonly open: (title: string, file: StacksFile, stacks: StackFacts[], shapes: Shape[]) => void) {
    byId("item-close").addEventListener("click", () => this.dialog.close());
    this.dialog.addEventListener("click", (event) => event.target === this.dialog && this.dialog.close());
  }

  async show(): Promise<void> {
    try {
      const items = await get<Item[]>("/api/gallery");
      const folders = new Map<string, Item[]>();
      for (const item of items) folders.set(item.folder, [...(folders.get(item.folder) ?? []), item]);
      const parts = [...folders].map(([folder, inside], i) =>
        el("details", { open: i < 6 }, el("summary", {}, folder === "." ? "this folder" : folder, el("span", { class: "told" }, ` ${inside.length}`)), el("div", { class: "cards" }, ...inside.map((item) => this.card(item)))),
      );
      const none = "There are no results below this folder yet: `stackgen sample` and `stackgen report` make some.";
      this.list.replaceChildren(...(parts.length ? parts : [el("p", {}, none)]));
    } catch (error) {
      this.list.replaceChildren(el("p", { class: "error", role: "alert" }, told(error)));
    }
  }

  private card(item: Item): HTMLElement {
    const address = `/api/gallery/${item.id}`;
    const face = item.kind === "picture" ? el("img", { src: address, alt: "", loading: "lazy" }) : el("span", { class: "face", "aria-hidden": "true" }, FACES[item.kind]);
    const document = item.kind === "report" || item.kind === "page"; // opens in a tab of its own
    const card = document ? el("a", { class: "card", href: address, target: "_blank" }) : button("", () => void this.look(item, address), { class: "card" });
    card.append(face, el("span", {}, item.name));
    return card;
  }

  private async look(item: Item, address: string): Promise<void> {
    const title = `${item.folder}/${item.name}`;
    try {
      if (item.kind === "picture") return this.present(title, el("img", { src: address, alt: title }));
      if (item.kind === "table") {
        const { rows } = await get<{ rows: string[][] }>(address);
        const [head = [], ...body] = rows;
        const table = el("table", {}, el("thead", {}, el("tr", {}, ...head.map((cell) => el("th", { scope: "col" }, cell)))));
        table.append(el("tbody", {}, ...body.map((row) => el("tr", {}, ...row.map((cell) => el("td", {}, cell))))));
        return this.present(title, table);
      }
      this.present(title, el("p", {}, "Simulating …"));
      const { file, shapes } = await get<{ file: StacksFile; shapes: Shape[] }>(address);
      const numbers = file.stacks.slice(0, MOST_OPENED).map((_, stack) => stack);
      const stacks = await Promise.all(numbers.map((stack) => post<StackFacts>("/api/check", { file, stack })));
      this.dialog.close();
      this.open(title, file, stacks, shapes);
    } catch (error) {
      this.present(title, el("p", { class: "error", role: "alert" }, told(error)));
    }
  }

  private present(title: string, content: HTMLElement): void {
    byId("item-title").textContent = title;
    byId("item-content").replaceChildren(content);
    if (!this.dialog.open) this.dialog.showModal();
  }
}
