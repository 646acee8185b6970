// Requests to the server, and its events.

/** @typedef {{width: number, height: number, fx: number, fy: number, cx: number, cy: number}} Camera */
/** @typedef {{name: string, camera: Camera, rotation: number[], translation: number[], held_out: boolean}} Photo */
/** @typedef {{x: number, y: number, inside: boolean}} Point */
/** @typedef {{x0: number, y0: number, x1: number, y1: number}} Box */
/** @typedef {{photo: number, points: Point[], boxes: Box[], granularity: number | null}} Prompts */
/** @typedef {{width: number, height: number, runs: number[], revision: number}} LabelMap */
/** @typedef {{camera: Camera, rotation: number[], translation: number[]}} View */
/** @typedef {{number: number, name: string, splats: number, photos: number, photo: number}} Listed */
/**
 * @typedef {{name: string, provider: string, splats: number, size: number, photos: Photo[], centre: number[], up: number[],
 *   listed: Listed[], palette: number[][], tree: boolean, snapshot: number | null, texts: boolean}} Description
 */
/** @typedef {{step: number, loss: number, psnr: number, splats: number, left_out: number}} Moment */
/** @typedef {{photos: string[], history: Moment[], snapshot: number | null}} Training */
/** @typedef {{photo: number | null, towards: number | null, share: number}} Appearance */
/**
 * @typedef {{id: number, name: string, colour: number, visible: boolean, locked: boolean, appearance: Appearance | null,
 *   splats: number, selection: string, prompted: boolean, edited: boolean}} Item
 */
/** @typedef {{photos: number, agreement: number | null}} SideAgreement */
/**
 * @typedef {{value: number, agreement: number | null, worst_side_agreement: number | null, levels_agreement: number | null,
 *   prompted_side: SideAgreement, far_side: SideAgreement, lopsided: string | null, next_click: number | null,
 *   photos: {photo: number, prompted: boolean, far: boolean, agreement: number, shown: number, disagrees: boolean}[]}} Confidence
 */
/**
 * @typedef {{revision: number, sequence: number,
 *   draft: {prompts: Prompts[], listed: number | null, of: number | null, alternative: number, text: string | null},
 *   answer: {number: number, state: string, step: any, splats: number, alternatives: any[], error: string | null, seconds: number,
 *     confidence: Confidence | null, scores: number[]},
 *   objects: Item[], isolated: number | null, appearance: Appearance, corrected: number[], cut_spikes: boolean, changes: string,
 *   undo: string | null, redo: string | null, notes: string[], saving: {object: number, done: number, photos: number}[]}} State
 */

/** A refusal by the server, in its words. */
export class Refused extends Error {
  /** @param {number} code @param {any} body */
  constructor(code, body) {
    super(body?.error ?? body?.reason ?? String(code));
    this.code = code;
    this.body = body;
  }
}

/** The code of a refusal that holds for a time only. */
const TOO_MANY = 429;
/** Seconds to wait where a refusal does not name them. */
const WAIT = 1;
/** How often an image is requested that does not come. */
const TRIES = 4;

/** Waits, unless nobody needs it any more. @param {number} seconds @param {AbortSignal | null | undefined} signal @returns {Promise<void>} */
function pause(seconds, signal) {
  return new Promise((done, stopped) => {
    const timer = setTimeout(done, 1000 * seconds);
    signal?.addEventListener("abort", () => {
      clearTimeout(timer);
      stopped(signal.reason);
    }, { once: true });
  });
}

/** Sends a request, and sends it again where the server has too many at present. @param {string} path @param {RequestInit} [options] */
export async function send(path, options = {}) {
  for (;;) {
    const response = await fetch(path, options);
    if (response.status === TOO_MANY) {
      await pause(Number(response.headers.get("retry-after")) || WAIT, options.signal);
      continue;
    }
    // 202: the session is not open yet.
    if (response.ok && response.status !== 202) return response;
    throw new Refused(response.status, await response.json().catch(() => null));
  }
}

/** @param {string} path @param {AbortSignal} [signal] */
export async function getJson(path, signal) {
  return (await send(path, { signal })).json();
}

/** Shows an image; one that does not come is requested again a few times. @param {HTMLImageElement} image @param {string} path */
export function showImage(image, path) {
  let tries = 1;
  image.onerror = async () => {
    if (tries === TRIES) return;
    await pause(WAIT * tries++, null);
    // Another one may be shown by then.
    if (image.getAttribute("src") === path) image.src = path;
  };
  image.src = path;
}

/** The requests about one run. */
export class Run {
  /** @param {string} name */
  constructor(name) {
    this.name = name;
    this.base = `/api/v1/runs/${encodeURIComponent(name)}`;
  }

  /** @returns {Promise<Description>} */
  describe() {
    return getJson(this.base);
  }

  /** The photos and the curves of a run that may have no scene yet. @returns {Promise<Training>} */
  training() {
    return getJson(`${this.base}/training`);
  }

  /** @param {number} photo @param {number} size */
  earlyPhoto(photo, size) {
    return `${this.base}/training/photos/${photo}?size=${size}`;
  }

  /** @param {string} path @param {unknown} body @param {AbortSignal} [signal] */
  async post(path, body, signal) {
    const headers = { "content-type": "application/json" };
    return send(`${this.base}/${path}`, { method: "POST", headers, body: JSON.stringify(body), signal });
  }

  /** @param {object} action @returns {Promise<State>} */
  async act(action) {
    return (await this.post("act", action)).json();
  }

  /** @param {{photo: number, x: number, y: number, granularity: number | null, view?: View}} at @param {AbortSignal} signal @returns {Promise<LabelMap | null>} */
  async hover(at, signal) {
    return (await this.post("hover", at, signal)).json();
  }

  /** @param {View & {at: number[]}} at @returns {Promise<{photo: number, x: number, y: number, point: number[]} | null>} */
  async pick(at) {
    return (await this.post("pick", at)).json();
  }

  /** @param {View & {marks: boolean, background?: boolean}} view @returns {Promise<Blob>} */
  async frame(view) {
    return (await this.post("frame", view)).blob();
  }

  /** @param {number} photo @returns {Promise<LabelMap>} */
  labels(photo) {
    return getJson(`${this.base}/photos/${photo}/labels`);
  }

  /** @param {number} id @param {AbortSignal} signal @returns {Promise<number[]>} */
  photosOf(id, signal) {
    return getJson(`${this.base}/objects/${id}/photos`, signal);
  }

  /** @param {number} photo @param {number} size */
  photo(photo, size) {
    return `${this.base}/photos/${photo}?size=${size}`;
  }

  /** @param {number} photo @returns {Promise<LabelMap>} */
  transients(photo) {
    return getJson(`${this.base}/photos/${photo}/transients`);
  }

  /** Writes an object as a selection of the run: the request stays open until it is written. @param {number} id @returns {Promise<{selection: string}>} */
  async save(id) {
    return (await this.post(`objects/${id}/save`, {})).json();
  }

  /** @param {string} path */
  async bytes(path) {
    return (await send(`${this.base}/${path}`)).arrayBuffer();
  }

  /** A file as it arrives. @param {string} path @param {AbortSignal} signal */
  async stream(path, signal) {
    return (await send(`${this.base}/${path}`, { signal })).body;
  }

  /** What objects change of the splats, and its version. @param {AbortSignal} signal @returns {Promise<{version: string, bytes: ArrayBuffer}>} */
  async changes(signal) {
    const response = await send(`${this.base}/changes`, { signal });
    return { version: response.headers.get("segwild-version") ?? "", bytes: await response.arrayBuffer() };
  }

  /** @param {number} id @param {string} format */
  file(id, format) {
    return `${this.base}/objects/${id}/${format}`;
  }

  /**
   * Follows the state; the browser connects again by itself, unless the session was put away.
   * @param {(state: State) => void} changed @param {(connected: boolean) => void} connection @param {() => void} gone
   */
  follow(changed, connection, gone) {
    const source = new EventSource(`${this.base}/events`);
    source.addEventListener("state", event => {
      connection(true);
      changed(JSON.parse(event.data));
    });
    source.onerror = () => (source.readyState === EventSource.CLOSED ? gone() : connection(false));
    return source;
  }
}
