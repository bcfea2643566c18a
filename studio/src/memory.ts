// What is never lost: the drawing and the settings, in this browser and in the link.

import { Bitmap } from "./draw/bitmap";
import { DEFAULTS, type Settings } from "./settings";

const KEY = "stackgen-studio";

export interface State {
  drawing: Bitmap;
  settings: Settings;
}

export function remember(state: State): void {
  try {
    localStorage.setItem(KEY, written(state));
  } catch {
    // A browser that keeps nothing: the link still holds it.
  }
}

/** The state of the link, else that of the last visit. */
export function recall(): State | null {
  for (const text of [location.hash.slice(1), localStorage.getItem(KEY)]) {
    const state = text ? read(text) : null;
    if (state) return state;
  }
  return null;
}

/** The address that carries drawing and settings. */
export function linkTo(state: State): string {
  return `${location.origin}/#${written(state)}`;
}

function written({ drawing, settings }: State): string {
  const changed = Object.entries(settings).filter(([key, value]) => JSON.stringify(value) !== JSON.stringify(DEFAULTS[key as keyof Settings]));
  const wishes = changed.length ? `.${encodeURIComponent(JSON.stringify(Object.fromEntries(changed)))}` : "";
  return `${drawing.cells}.${drawing.shorten()}${wishes}`;
}

function read(text: string): State | null {
  try {
    const [cells, bits = "", ...rest] = text.split(".");
    const number = Number(cells);
    if (!(number >= 4 && number <= 8)) return null;
    const settings = rest.length ? JSON.parse(decodeURIComponent(rest.join("."))) : {};
    return { drawing: Bitmap.lengthen(bits, number), settings: sound({ ...DEFAULTS, ...settings }) };
  } catch {
    return null;
  }
}

/** Settings of the right kinds, whatever a link holds. */
function sound(settings: Settings): Settings {
  const right = Object.entries(DEFAULTS).map(([key, value]) => {
    const given = settings[key as keyof Settings];
    return [key, typeof given === typeof value ? given : value];
  });
  return Object.fromEntries(right) as Settings;
}
