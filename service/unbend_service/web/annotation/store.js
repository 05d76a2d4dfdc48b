// What is kept: one JSON a picture, beside it. Saving waits for a pause of the hand, and is finished before another
// picture is opened.

import { call } from "../page/api.js";

const PAUSE_MS = 250;

export async function overview() {
  return (await call("/annotation")).json();
}

export async function read(name) {
  return (await call(`/annotation/curves/${encodeURIComponent(name)}`)).json();
}

export const pictureAddress = (name) => `/annotation/pictures/${encodeURIComponent(name)}`;

export class Saver {
  /** @param {(kept: object) => void} onKept @param {(error: Error) => void} onError */
  constructor(onKept, onError) {
    this.onKept = onKept;
    this.onError = onError;
    this.waiting = null;
    this.running = Promise.resolve();
    addEventListener("pagehide", () => this.flush());
  }

  keep(name, annotation) {
    clearTimeout(this.timer);
    this.waiting = { name, body: JSON.stringify(annotation) };
    this.timer = setTimeout(() => this.flush(), PAUSE_MS);
  }

  /** Resolves when everything is kept. */
  flush() {
    clearTimeout(this.timer);
    const job = this.waiting;
    this.waiting = null;
    if (job) this.running = this.running.then(() => this.send(job));
    return this.running;
  }

  async send({ name, body }) {
    try {
      const headers = { "Content-Type": "application/json" };
      const answer = await call(`/annotation/curves/${encodeURIComponent(name)}`, { method: "PUT", headers, body, keepalive: body.length < 60_000 });
      this.onKept(name, await answer.json());
    } catch (error) {
      this.onError(error);
    }
  }
}
