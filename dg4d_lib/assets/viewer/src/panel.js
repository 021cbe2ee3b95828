// Side panel: input picture, driving video and provenance.
import { addressOf } from "./embedded.js";

const LONG = 28; // characters; longer words are cut until they are clicked

/** Fills the panel; returns the element of the driving video, or null. */
export function fillPanel(facts, picture, video) {
  if (picture) shown("picture", picture, typeOf(picture));
  document.getElementById("facts").append(...Object.entries(facts).map(([name, value], i) => group(name, value, i === 0)));
  return video ? shown("video", video, "video/mp4") : null;
}

function shown(id, bytes, type) {
  const figure = document.getElementById(id);
  figure.hidden = false;
  figure.firstElementChild.src = addressOf(bytes, type);
  return figure.firstElementChild;
}

/** Detects PNG, JPEG or WebP by the first bytes. */
function typeOf(bytes) {
  return { 0x89: "image/png", 0xff: "image/jpeg" }[bytes[0]] ?? "image/webp";
}

function group(name, value, open) {
  const details = element("details", "", element("summary", name), content(value));
  details.open = open;
  return details;
}

/** Renders nested facts as nested tables. */
function content(value) {
  if (value === null || typeof value !== "object") return word(value);
  if (Array.isArray(value)) return element("ul", "", ...value.map((item) => element("li", "", content(item))));
  const rows = Object.entries(value).map(([name, inner]) => {
    const nested = inner !== null && typeof inner === "object";
    return nested ? group(name, inner, false) : element("div", "", element("dt", name), element("dd", "", word(inner)));
  });
  return element("dl", "", ...rows);
}

function word(value) {
  const text = String({ null: "–", "": "–", true: "yes", false: "no" }[value] ?? value);
  const span = element("span", text);
  if (text.length > LONG && !text.includes(" ")) {
    span.className = "long";
    span.title = text;
    span.addEventListener("click", () => span.classList.toggle("whole"));
  }
  return span;
}

function element(tag, text, ...children) {
  const made = document.createElement(tag);
  made.append(...(text ? [text] : []), ...children);
  return made;
}
