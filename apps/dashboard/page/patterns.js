// Fills of the timeline. Rule: a frame has a plain colour, an idle cause a coloured pattern. Causes therefore differ
// without colour, too.

import { colour, isDark } from "./theme.js";

const TILE = 8;
const FRAME_COLOURS = 12;

// Cause -> function that draws its tile of TILE x TILE pixels.
const STROKES = {
  starved: (pen) => {
    pen.fillRect(1, 1, 1.5, 1.5);
    pen.fillRect(5, 5, 1.5, 1.5);
  },
  blocked: (pen) => line(pen, [-1, 9, 9, -1], [-1, 1, 1, -1], [7, 9, 9, 7]),
  throttled: (pen) => line(pen, [0, 2, 8, 2], [0, 6, 8, 6]),
  preempted: (pen) => line(pen, [0, 0, 8, 8], [0, 8, 8, 0]),
  overhead: (pen) => line(pen, [2, 0, 2, 8], [6, 0, 6, 8]),
  join: (pen) => line(pen, [0, 0, 4, 8], [8, 0, 4, 8]),
  unexplained: (pen) => pen.fillRect(1, 1, 4, 4),
};

function line(pen, ...lines) {
  pen.beginPath();
  for (const [x0, y0, x1, y1] of lines) {
    pen.moveTo(x0, y0);
    pen.lineTo(x1, y1);
  }
  pen.stroke();
}

function tile(cause, ratio) {
  const canvas = document.createElement("canvas");
  canvas.width = canvas.height = Math.round(TILE * ratio);
  const pen = canvas.getContext("2d");
  pen.scale(canvas.width / TILE, canvas.height / TILE);
  pen.fillStyle = colour("idle");
  pen.fillRect(0, 0, TILE, TILE);
  pen.fillStyle = pen.strokeStyle = colour(`cause-${cause}`);
  pen.lineWidth = 1.3;
  STROKES[cause](pen);
  return canvas;
}

// Returns a pattern for `pen`, a 2D context whose unit is a CSS pixel, which has `ratio` device pixels a side.
export function causePattern(pen, cause, ratio) {
  const pattern = pen.createPattern(tile(cause, ratio), "repeat");
  pattern.setTransform(new DOMMatrix().scale(1 / ratio));
  return pattern;
}

// Returns the fills of frames. Two degrees of lightness alternate, and neighbours differ much in hue.
export function frameColours() {
  const light = isDark() ? [0.72, 0.8] : [0.45, 0.54];
  return Array.from({ length: FRAME_COLOURS }, (_, index) => {
    const hue = (index * 360 * 5) / FRAME_COLOURS;
    return `oklch(${light[index % 2]} 0.1 ${hue % 360})`;
  });
}
