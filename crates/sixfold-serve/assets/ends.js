// The ends of a measured length, marked in photographs without a board. What is marked but not saved yet outlives a reload of the page.

const KEY = (id) => `ends-${id}`;

export class Ends {
  /** `changed` is called after each mark. */
  constructor(changed) {
    this.changed = changed;
    this.id = null;
    this.saved = true;
    this.marks = new Map();
  }

  /** Takes over the marks of a teaching, unless there are newer ones of it here. */
  show(teaching) {
    const saved = new Map(teaching.ends.map(({ photograph, points }) => [photograph, points]));
    if (this.id === teaching.id && !this.saved) return;
    this.id = teaching.id;
    const kept = sessionStorage.getItem(KEY(this.id));
    this.marks = kept ? new Map(JSON.parse(kept)) : saved;
    this.saved = !kept;
  }

  /** The marks in a photograph: pixels, or null. */
  of(number) {
    return this.marks.get(number) || [null, null];
  }

  set(number, end, pixel) {
    const points = [...this.of(number)];
    points[end] = pixel && pixel.map((v) => Math.round(100 * v) / 100);
    if (points[0] || points[1]) this.marks.set(number, points);
    else this.marks.delete(number);
    this.saved = false;
    sessionStorage.setItem(KEY(this.id), JSON.stringify([...this.marks]));
    this.changed();
  }

  /** The server has them. */
  keep() {
    sessionStorage.removeItem(KEY(this.id));
    this.saved = true;
  }

  /** How many photographs each end is marked in. */
  counts() {
    return [0, 1].map((end) => [...this.marks.values()].filter((points) => points[end]).length);
  }

  /** As the API takes them. */
  list() {
    const sorted = [...this.marks].sort((a, b) => a[0] - b[0]);
    return sorted.map(([photograph, points]) => ({ photograph, points }));
  }
}
