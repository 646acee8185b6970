// The tools: what a pointer does in the photo and in 3D.

/** All of them, by their names: clicks and boxes, and those that mark splats by hand. */
export const TOOLS = ["prompt", "rectangle", "lasso", "brush", "sphere"];
/** Those that have a size. */
export const SIZED = ["brush", "sphere"];
/** That size: a radius in shares of a view's long side, at first, at least, at most, and by what a step changes it. */
export const RADIUS = { first: 0.02, least: 0.002, most: 0.2, step: 1.25 };
