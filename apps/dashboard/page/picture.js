// The avatar. Rule: the newest picture is shown when the browser draws the page. While nobody sees the avatar, the page
// requests no picture.

const DEGREES_A_PIXEL = 0.4;
const DEGREES_A_KEY = 5;
const ZOOM_A_KEY = 1.1;
const ZOOM_A_WHEEL = 0.0015;
const SEND_EVERY_MS = 40;

export class Picture {
  // camera: callbacks {orbit(dx, dy), zoom(factor), reset()}; `dx` and `dy` are degrees.
  constructor(canvas, camera) {
    this.canvas = canvas;
    this.pen = canvas.getContext("bitmaprenderer");
    this.camera = camera;
    this.isSeen = true;
    this.shown = null;
    this.turn = [0, 0];
    this.factor = 1;
    this.sentAt = 0;
    new IntersectionObserver((entries) => {
      this.isSeen = entries.at(-1).isIntersecting;
    }).observe(canvas);
    this.#listen();
  }

  get isWanted() {
    return this.isSeen && !document.hidden;
  }

  // Decodes and shows {frame, mediaMs, ageMs, jpeg}; false for bytes that are no picture.
  async show(picture) {
    let bitmap;
    try {
      bitmap = await createImageBitmap(picture.jpeg);
    } catch {
      return false;
    }
    this.pen.transferFromImageBitmap(bitmap);
    this.shown = picture;
    this.canvas.dataset.frame = picture.frame;
    return true;
  }

  // Sends all movements by mouse and keys since the last call together, at most once in SEND_EVERY_MS.
  tick(now) {
    if (now - this.sentAt < SEND_EVERY_MS) return;
    if (this.turn[0] || this.turn[1]) {
      this.camera.orbit(...this.turn);
      this.turn = [0, 0];
      this.sentAt = now;
    }
    if (this.factor !== 1) {
      this.camera.zoom(this.factor);
      this.factor = 1;
      this.sentAt = now;
    }
  }

  orbit(dx, dy) {
    this.turn = [this.turn[0] + dx, this.turn[1] + dy];
  }

  zoom(factor) {
    this.factor *= factor;
  }

  // Moves the camera if `key` is a key for it, and returns whether it is.
  key(key) {
    const actions = {
      ArrowLeft: () => this.orbit(-DEGREES_A_KEY, 0),
      ArrowRight: () => this.orbit(DEGREES_A_KEY, 0),
      ArrowUp: () => this.orbit(0, -DEGREES_A_KEY),
      ArrowDown: () => this.orbit(0, DEGREES_A_KEY),
      "+": () => this.zoom(ZOOM_A_KEY),
      "=": () => this.zoom(ZOOM_A_KEY),
      "-": () => this.zoom(1 / ZOOM_A_KEY),
      0: () => this.camera.reset(),
    };
    actions[key]?.();
    return key in actions;
  }

  #listen() {
    const { canvas } = this;
    const pointers = new Map();
    canvas.addEventListener("pointerdown", (event) => {
      canvas.setPointerCapture(event.pointerId);
      pointers.set(event.pointerId, [event.clientX, event.clientY]);
    });
    canvas.addEventListener("pointermove", (event) => this.#drag(pointers, event));
    for (const name of ["pointerup", "pointercancel"]) {
      canvas.addEventListener(name, (event) => pointers.delete(event.pointerId));
    }
    canvas.addEventListener("dblclick", () => this.camera.reset());
    canvas.addEventListener(
      "wheel",
      (event) => {
        event.preventDefault();
        this.zoom(Math.exp(-event.deltaY * ZOOM_A_WHEEL));
      },
      { passive: false },
    );
  }

  #drag(pointers, event) {
    const before = pointers.get(event.pointerId);
    if (!before) return;
    const here = [event.clientX, event.clientY];
    const others = [...pointers].filter(([id]) => id !== event.pointerId).map(([, place]) => place);
    pointers.set(event.pointerId, here);
    if (others.length === 0) {
      this.orbit((here[0] - before[0]) * DEGREES_A_PIXEL, (here[1] - before[1]) * DEGREES_A_PIXEL);
      return;
    }
    const distance = (place) => Math.hypot(place[0] - others[0][0], place[1] - others[0][1]);
    if (distance(before) > 8) this.zoom(distance(here) / distance(before));
  }
}
