// Shape of the arrows of movements.

/**
 * Where a curve from one point to another bends: towards the middle of the junction, but not all the way.
 * @param {number[]} from @param {number[]} via @param {number[]} to
 */
export function bendOf(from, via, to) {
  return [0, 1].map((axis) => 0.6 * via[axis] + 0.2 * (from[axis] + to[axis]));
}

/** Whether it is known where a movement begins and ends. @param {any} movement */
export const isDrawn = (movement) => Boolean(movement.from_m && movement.via_m && movement.to_m);
