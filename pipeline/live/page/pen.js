// Converts pointers to points on the skin, in taxels: 0 is the centre of the first row or column.

const BEYOND = 1.5; // taxels beyond the outer sensors to which a pen's position is limited
const BEAT_MS = 12;
const APART_MS = 8; // interval of messages while the pen moves
const MAX_POINTS = 500; // points in a message, of which the server accepts a few more

export class Pen {
  // report(points, now): [[ms, right, down, pressure, touches], ...]
  constructor(canvas, report) {
    this.canvas = canvas;
    this.report = report;
    this.sensor = null; // rows and columns, while writing is possible
    this.pointer = null;
    this.settled = true;
    this.reportedAt = -Infinity;
    this.waiting = [];
    canvas.addEventListener("pointerdown", (event) => this.down(event));
    // Movements without delay if the browser reports them, and again with its next frame.
    for (const move of ["pointerrawupdate", "pointermove"])
      canvas.addEventListener(move, (event) => this.move(event));
    for (const end of ["pointerup", "pointercancel", "lostpointercapture"])
      canvas.addEventListener(end, (event) => this.up(event));
    // A writing finger must not scroll or select text.
    canvas.addEventListener("touchstart", (event) => event.preventDefault(), { passive: false });
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
  }

  get writes() {
    return this.pointer !== null;
  }

  down(event) {
    if (this.sensor === null) return;
    if (event.pointerId === this.pointer) this.up(event); // its end was not reported
    if (this.pointer !== null || (event.pointerType === "mouse" && event.button !== 0)) return;
    document.activeElement?.blur(); // of a list or a number, which would take the keys of the classes
    this.pointer = event.pointerId;
    try {
      this.canvas.setPointerCapture(event.pointerId);
    } catch {
      // the pointer no longer exists
    }
    this.last = this.point(event, 1);
    this.send([this.last]);
    this.beat();
  }

  move(event) {
    if (event.pointerId !== this.pointer) return;
    const every = event.getCoalescedEvents?.() ?? [];
    for (const reported of every.length ? every : [event]) {
      const point = this.point(reported, 1);
      if (point[0] <= this.last[0]) continue; // processed already
      this.waiting.push(point);
      this.last = point;
    }
    if (!this.waiting.length) return;
    if (performance.now() - this.reportedAt >= APART_MS) this.send([]);
  }

  up(event) {
    if (event.pointerId !== this.pointer) return;
    this.lift(this.time(event));
  }

  // Lifts the pen even if it is still on the skin; it writes again when it lands again.
  lift(at = performance.now()) {
    if (this.pointer === null) return;
    this.pointer = null;
    const [, right, down, pressure] = this.last;
    this.send([[at, right, down, pressure, 0]]);
  }

  time(event) {
    const now = performance.now();
    return event.timeStamp > now - 1000 && event.timeStamp <= now ? event.timeStamp : now;
  }

  point(event, touches) {
    const box = this.canvas.getBoundingClientRect();
    const place = (share, side) =>
      Math.min(Math.max(side * share - 0.5, -BEYOND), side - 1 + BEYOND);
    // A finger's pressure is rarely measured: 0 and 1 are ignored.
    const hasPressure = event.pressure > 0 && (event.pointerType === "pen" || event.pressure < 1);
    return [
      this.time(event),
      place((event.clientX - box.left) / box.width, this.sensor.columns),
      place((event.clientY - box.top) / box.height, this.sensor.rows),
      hasPressure ? event.pressure : 0.5,
      touches,
    ];
  }

  send(points) {
    points = [...this.waiting.splice(0), ...points];
    this.settled = false;
    this.reportedAt = performance.now();
    do {
      const piece = points.splice(0, MAX_POINTS);
      // The skin's time must not pass the points of the next piece.
      this.report(piece, points.length ? piece.at(-1)[0] : this.reportedAt);
    } while (points.length);
  }

  // The skin's time continues although nobody writes, also that of an example.
  watch() {
    this.settled = false;
    this.beat();
  }

  // The skin's time also advances while the pen rests, and shortly after it is lifted.
  beat() {
    if (this.beating) return;
    const next = () => {
      this.beating = !this.settled || this.writes;
      if (!this.beating) return;
      if (this.waiting.length || performance.now() - this.reportedAt >= BEAT_MS) this.send([]);
      requestAnimationFrame(next);
    };
    this.beating = true;
    requestAnimationFrame(next);
  }
}
