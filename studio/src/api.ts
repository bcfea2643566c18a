// Asks the server. A request that is aborted is cancelled there at once.

const client = Array.from(crypto.getRandomValues(new Uint8Array(8)), (byte) => byte.toString(16)).join("-");

/** What the server refused, in its sentence. */
export class Refused extends Error {}

async function ask(path: string, body: unknown, signal?: AbortSignal): Promise<Response> {
  let answer: Response;
  try {
    answer = await fetch(path, {
      method: "POST",
      headers: { "Content-Type": "application/json", "X-Client": client },
      body: JSON.stringify(body),
      signal: signal ?? null,
    });
  } catch (error) {
    if (signal?.aborted) throw error;
    throw new Refused("The studio does not answer: is `stackgen studio` still running?");
  }
  if (!answer.ok) throw new Refused(sentence((await answer.json()).detail));
  return answer;
}

export async function get<T>(path: string): Promise<T> {
  const answer = await fetch(path);
  const content = await answer.json();
  if (!answer.ok) throw new Refused(sentence(content.detail));
  return content;
}

export async function post<T>(path: string, body: unknown, signal?: AbortSignal): Promise<T> {
  return (await ask(path, body, signal)).json();
}

export async function postForFile(path: string, body: unknown, signal?: AbortSignal): Promise<Blob> {
  return (await ask(path, body, signal)).blob();
}

/** Yields the messages of an answer that has one on each line. */
export async function* messages<T extends { kind: string }>(path: string, body: unknown, signal: AbortSignal): AsyncGenerator<T> {
  const answer = await ask(path, body, signal);
  const reader = answer.body!.pipeThrough(new TextDecoderStream()).getReader();
  let rest = "";
  for (;;) {
    const { value, done } = await reader.read();
    if (done) return;
    const lines = (rest + value).split("\n");
    rest = lines.pop()!;
    for (const line of lines) {
      const message = JSON.parse(line);
      if (message.kind === "error") throw new Refused(sentence(message.detail));
      yield message;
    }
  }
}

/** Tells whether an error only says that somebody cancelled. */
export function isAbort(error: unknown): boolean {
  return error instanceof DOMException && error.name === "AbortError";
}

export function told(error: unknown): string {
  return error instanceof Error ? error.message : String(error);
}

function sentence(text: string): string {
  const whole = text.charAt(0).toUpperCase() + text.slice(1);
  return /[.!?]$/.test(whole) ? whole : `${whole}.`;
}
