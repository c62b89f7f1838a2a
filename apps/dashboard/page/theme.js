// Dark or light. Rule: the system decides until the person chooses. Canvases take their colours from the style sheet.

const KEY = "trilane.theme";
const root = document.documentElement;
const dark = matchMedia("(prefers-color-scheme: dark)");
const calm = matchMedia("(prefers-reduced-motion: reduce)");
const probe = document.createElement("span");
probe.hidden = true;
document.body.append(probe);

let listeners = [];
let cache = new Map();

export function isDark() {
  const chosen = root.dataset.theme;
  return chosen ? chosen === "dark" : dark.matches;
}

export function wantsCalm() {
  return calm.matches;
}

// Returns the present colour of the style sheet's variable `--name`, in a form that a canvas accepts.
export function colour(name) {
  if (!cache.has(name)) {
    probe.style.color = `var(--${name})`;
    cache.set(name, getComputedStyle(probe).color);
  }
  return cache.get(name);
}

export function onThemeChange(listener) {
  listeners = [...listeners, listener];
}

function changed() {
  cache = new Map();
  for (const listener of listeners) listener();
}

function chooseTheme(theme) {
  if (theme === "system") delete root.dataset.theme;
  else root.dataset.theme = theme;
  try {
    localStorage.setItem(KEY, theme);
  } catch {
    // a browser that stores nothing forgets the choice when the page is closed
  }
  changed();
}

// Follows `select`, a list with the values system, light and dark.
export function followThemeSwitch(select) {
  let stored = "system";
  try {
    stored = localStorage.getItem(KEY) ?? "system";
  } catch {
    // as above
  }
  select.value = ["light", "dark"].includes(stored) ? stored : "system";
  chooseTheme(select.value);
  select.addEventListener("change", () => chooseTheme(select.value));
  dark.addEventListener("change", changed);
}
