// The page: drawing and wishes on one side, what becomes of them on the other. Where a page holds stacks, it shows them.

import { get, told } from "./api";
import { byId, copied, el } from "./dom";
import { preset } from "./draw/presets";
import { Sketchpad } from "./draw/sketchpad";
import { Gallery } from "./gallery";
import { linkTo, recall, remember } from "./memory";
import { Pictures } from "./pictures";
import { DEFAULTS, SettingsForm } from "./settings";
import { show } from "./shown";
import type { Start } from "./types";
import { Pane } from "./view/pane";

async function begin(): Promise<void> {
  const start = await get<Start>("/api/start");
  const state = recall();
  const settings = { ...DEFAULTS, ...state?.settings };
  for (const key of ["method", "compared"] as const)
    if (settings[key] && !start.methods.some((method) => method.name === settings[key])) settings[key] = DEFAULTS[key];
  const save = () => remember({ drawing: pad.drawing, settings });
  const form = new SettingsForm(start, settings, save);
  const pad = new Sketchpad(save);
  pad.begin(state && !state.drawing.empty ? state.drawing : preset("House"));
  const panes = [1, 2].map((number) => new Pane(start, number, (counts) => number === 1 && form.predict(counts)));
  byId("draw").append(pad.element);
  byId("ask").append(form.element);
  byId("reading").append(new Pictures(pad).element);
  byId("panes").append(...panes.map((pane) => pane.element));
  const generate = byId<HTMLButtonElement>("generate");
  const cancel = byId<HTMLButtonElement>("cancel");
  const error = byId("asking-error");

  generate.addEventListener("click", async () => {
    error.textContent = "";
    if (pad.drawing.empty) {
      error.textContent = "Nothing is drawn yet: draw a structure, or choose an example.";
      return;
    }
    if (settings.mode !== "any" && !Object.values(settings.counts).some(Boolean)) {
      error.textContent = "No blocks are chosen: give at least one, or have them chosen for you.";
      return;
    }
    const methods = [settings.method, settings.compared].map((name) => form.method(name));
    panes[1]!.element.hidden = !methods[1];
    byId("panes").classList.toggle("two", Boolean(methods[1]));
    document.body.classList.add("asked");
    cancel.hidden = false;
    const first = panes[0]!.element;
    if (first.getBoundingClientRect().top > innerHeight * 0.8) first.scrollIntoView({ behavior: "smooth" });
    const drawing = { cells: pad.drawing.cells, bits: pad.drawing.pack() };
    await Promise.all(methods.map((method, i) => method && panes[i]!.run(method, drawing, form.wish(method))));
    cancel.hidden = true;
  });
  cancel.addEventListener("click", () => panes.forEach((pane) => pane.cancel()));
  byId("link").addEventListener("click", async () => {
    const link = linkTo({ drawing: pad.drawing, settings });
    history.replaceState(null, "", link);
    byId("link-told").textContent = (await copied(link)) ? "The link is in the address bar, and copied." : "The link is in the address bar.";
  });
  const gallery = new Gallery((title, file, stacks, shapes) => {
    turn("studio");
    panes[1]!.element.hidden = true;
    byId("panes").classList.remove("two");
    panes[0]!.open(title, file, stacks, shapes);
  });
  const turn = (to: "studio" | "gallery") => {
    for (const name of ["studio", "gallery"]) {
      byId(name).hidden = name !== to;
      byId(`to-${name}`).setAttribute("aria-pressed", String(name === to));
    }
    if (to === "gallery") void gallery.show();
  };
  byId("to-studio").addEventListener("click", () => turn("studio"));
  byId("to-gallery").addEventListener("click", () => turn("gallery"));
  byId("studio").hidden = false; // all of it at once, so that nothing jumps
  themes(() => {
    pad.paint();
    panes.forEach((pane) => pane.colour());
  });
  panes[1]!.element.hidden = true;
  panes[0]!.stage.say("draw, then press Generate");
}

/** The button between light and dark; the system's choice holds until it is pressed. */
function themes(changed: () => void): void {
  const root = document.documentElement;
  const kept = localStorage.getItem("stackgen-theme");
  if (kept) root.dataset.theme = kept;
  byId("theme").addEventListener("click", () => {
    const dark = root.dataset.theme ? root.dataset.theme === "dark" : matchMedia("(prefers-color-scheme: dark)").matches;
    root.dataset.theme = dark ? "light" : "dark";
    localStorage.setItem("stackgen-theme", root.dataset.theme);
    changed();
  });
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", changed);
  changed();
}

async function open(): Promise<void> {
  const stacks = document.getElementById("stacks");
  try {
    if (stacks) show(JSON.parse(stacks.textContent!));
    else await begin();
  } catch (error) {
    document.body.replaceChildren(el("p", { class: "error", role: "alert" }, told(error)));
  }
}

void open();
