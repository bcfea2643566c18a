// What can be taken away: files, and the command line that makes the same again.

import { postForFile, told } from "../api";
import { button, bytesOf, copied, download, el } from "../dom";
import type { Message } from "../types";
import type { World } from "./world";

export function downloads(result: Extract<Message, { kind: "file" }>, stack: number, world: World): HTMLElement {
  const status = el("span", { role: "status", class: "told" });
  const offer = async (name: string, make: () => Promise<Blob> | Blob) => {
    status.textContent = `${name} …`;
    try {
      download(name, await make());
      status.textContent = "";
    } catch (error) {
      status.textContent = told(error);
    }
  };
  const exported = (format: string) => postForFile("/api/export", { file: result.file, stack, format });
  const number = stack + 1;
  const row = el(
    "div",
    { class: "row downloads" },
    button("stacks.json", () => offer("stacks.json", () => new Blob([JSON.stringify(result.file, null, 1)], { type: "application/json" }))),
    button("GLB", () => offer(`stack-${number}.glb`, () => exported("glb"))),
    button("PNG", () => offer(`stack-${number}.png`, () => world.picture())),
    button("MP4", () => offer(`stack-${number}.mp4`, () => exported("mp4"))),
  );
  if (result.picture) row.append(button("silhouette.png", () => offer("silhouette.png", () => new Blob([bytesOf(result.picture)], { type: "image/png" }))));
  row.append(status);
  if (!result.command) return row;
  const copy = button("Copy", async () => (status.textContent = (await copied(result.command)) ? "Copied." : "This browser does not let it be copied: mark it instead."), { "aria-label": "Copy the command" });
  return el("div", {}, row, el("p", { class: "hint" }, "The same on the command line, beside silhouette.png:"), el("div", { class: "command" }, el("code", {}, result.command), copy));
}
