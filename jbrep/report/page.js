"use strict";
const root = document.documentElement;
const setTheme = (name) => { root.dataset.theme = name; };
setTheme(matchMedia("(prefers-color-scheme: dark)").matches ? "dark" : "light");
document.getElementById("theme").addEventListener("click", () => {
  setTheme(root.dataset.theme === "dark" ? "light" : "dark");
});
let before = "light";
addEventListener("beforeprint", () => { before = root.dataset.theme; setTheme("light"); });
addEventListener("afterprint", () => setTheme(before));

const wide = document.querySelectorAll(".wide, .zoom, pre");
const markCut = () => {
  for (const each of wide) each.classList.toggle("cut", each.scrollWidth > each.clientWidth + 1);
};
addEventListener("load", markCut);
addEventListener("resize", markCut);

const amount = (row, column) => {
  const text = row.cells[column].textContent.trim();
  const number = parseFloat(text.replace(/[,<>\s]/g, ""));
  return { text, number };
};
const byText = (a, b) => a.text.localeCompare(b.text, undefined, { numeric: true });
const byNumber = (a, b) => {
  const missing = Number.isNaN(a.number) - Number.isNaN(b.number);
  return missing || a.number - b.number || byText(a, b);
};
for (const table of document.querySelectorAll("table.sortable")) {
  const heads = [...table.tHead.rows[0].cells];
  heads.forEach((head, column) => head.addEventListener("click", () => {
    const down = head.getAttribute("aria-sort") === "ascending";
    for (const each of heads) each.removeAttribute("aria-sort");
    head.setAttribute("aria-sort", down ? "descending" : "ascending");
    const rows = [...table.tBodies[0].rows];
    const compare = head.classList.contains("text") ? byText : byNumber;
    rows.sort((a, b) => compare(amount(a, column), amount(b, column)) * (down ? -1 : 1));
    table.tBodies[0].append(...rows);
  }));
}

const viewer = document.getElementById("viewer");
const stage = document.getElementById("stage");
const zoom = (factor) => {
  const image = stage.firstElementChild;
  image.style.width = `${image.getBoundingClientRect().width * factor}px`;
};
for (const button of document.querySelectorAll(".zoom")) {
  button.addEventListener("click", () => {
    const shown = button.querySelector(root.dataset.theme === "dark" ? ".dark" : ".light");
    const image = shown.cloneNode();
    stage.replaceChildren(image);
    viewer.showModal();
    const { clientWidth: width, clientHeight: height } = stage;
    const ratio = shown.naturalWidth / shown.naturalHeight;
    image.style.width = `${0.98 * Math.min(width, height * ratio)}px`;
  });
}
for (const button of viewer.querySelectorAll("[data-zoom]")) {
  button.addEventListener("click", () => zoom(Number(button.dataset.zoom)));
}
stage.addEventListener("wheel", (event) => {
  event.preventDefault();
  zoom(event.deltaY < 0 ? 1.1 : 1 / 1.1);
}, { passive: false });
stage.addEventListener("pointermove", (event) => {
  if (event.buttons) stage.scrollBy(-event.movementX, -event.movementY);
});
stage.addEventListener("dragstart", (event) => event.preventDefault());
document.getElementById("close").addEventListener("click", () => viewer.close());
