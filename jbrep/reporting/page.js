"use strict";
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
