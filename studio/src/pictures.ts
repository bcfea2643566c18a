// A picture becomes the drawing: it is chosen, dropped or pasted, and shown as it was read.

import { post, told } from "./api";
import { base64Of, byId, el } from "./dom";
import { Bitmap } from "./draw/bitmap";
import type { Sketchpad } from "./draw/sketchpad";
import type { Reading } from "./types";

const MOST_BYTES = 6_000_000;

export class Pictures {
  readonly element = el("div", { class: "reading", "aria-live": "polite" });

  constructor(private readonly pad: Sketchpad) {
    const input = byId<HTMLInputElement>("picture");
    input.addEventListener("change", () => {
      if (input.files?.[0]) void this.read(input.files[0]);
      input.value = "";
    });
    document.addEventListener("dragover", (event) => event.preventDefault());
    document.addEventListener("drop", (event) => {
      event.preventDefault();
      const file = event.dataTransfer?.files[0];
      if (file) void this.read(file);
    });
    document.addEventListener("paste", (event) => {
      const file = event.clipboardData?.files[0];
      if (file) void this.read(file);
    });
  }

  private async read(file: File): Promise<void> {
    this.element.replaceChildren(el("p", {}, `Reading ${file.name} …`));
    try {
      if (file.size > MOST_BYTES) throw new Error(`${file.name} has more than ${MOST_BYTES / 1e6} MB: scale it down first.`);
      const picture = base64Of(new Uint8Array(await file.arrayBuffer()));
      const reading = await post<Reading>("/api/read", { picture, cells: this.pad.drawing.cells });
      this.pad.replace(Bitmap.unpack(reading.bits, reading.cells));
      const image = el("img", { src: `data:image/png;base64,${reading.overlay}`, alt: "The picture, with the outline of what was read in red" });
      const notes = reading.notes.map((note) => el("p", { class: "note" }, note));
      this.element.replaceChildren(el("figure", {}, image, el("figcaption", {}, `Read as a ${reading.told}.`)), ...notes);
    } catch (error) {
      this.element.replaceChildren(el("p", { class: "error", role: "alert" }, `${told(error)} What was drawn is still there.`));
    }
  }
}
