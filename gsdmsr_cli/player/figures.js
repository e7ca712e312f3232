// Figures of how long things take.

const KEPT = 100;

/** Put a value at the end of a list of the last ones. */
export function note(list, value) {
  list.push(value);
  if (list.length > KEPT) list.shift();
}

/** Return the median of a list, or null if it is empty. */
export function median(list) {
  return [...list].sort((a, b) => a - b)[list.length >> 1] ?? null;
}
