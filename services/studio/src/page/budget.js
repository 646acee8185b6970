// How many splats a frame gets while the camera moves, by the time that frames take.

/** Milliseconds that a frame of the browser's may take: 30 a second. */
export const FRAME = 1000 / 30;
/** Splats of a moving frame at least: a scene of fewer is always whole. */
export const LEAST_SPLATS = 1 << 17;
/** Splats of a moving frame at most. */
export const MOST_SPLATS = 1 << 24;
/** Share of the time of a frame under which twice the splats will fit: the time grows at most as their number. */
const HALF = 0.45;

/** The number of splats that moving frames get. It halves where a frame takes too long, and doubles where twice as many fit. */
export class SplatBudget {
  constructor() {
    this.splats = MOST_SPLATS;
  }

  /** Takes how long a frame took, in milliseconds, and how many splats it had. @param {number} time @param {number} splats */
  measured(time, splats) {
    if (time > FRAME) this.splats = Math.max(LEAST_SPLATS, Math.min(this.splats, splats) / 2);
    else if (time < FRAME * HALF && splats >= this.splats) this.splats = Math.min(MOST_SPLATS, this.splats * 2);
  }
}
