"use strict";
// Tables of the class "sortable": a button in each heading sorts the rows by its column, then in the other direction.
(() => {
  const textOf = (row, column) => row.cells[column].textContent.trim();

  // Number of a cell; NaN for a text, and for a cell without a value.
  const numberOf = (text) => (text === "" ? NaN : Number(text.replace(/[,%≤\s]/g, "")));

  function order(rows, column) {
    const texts = rows.map((row) => textOf(row, column));
    const known = texts.filter((text) => text !== "" && text !== "–");
    if (known.some((text) => Number.isNaN(numberOf(text)))) {
      return (a, b) => textOf(a, column).localeCompare(textOf(b, column), undefined, { numeric: true });
    }
    return (a, b) => numberOf(textOf(a, column)) - numberOf(textOf(b, column));
  }

  function sort(table, heading, column) {
    const rows = [...table.tBodies[0].rows];
    const isFalling = heading.getAttribute("aria-sort") === "ascending";
    const isEmpty = (row) => ["", "–"].includes(textOf(row, column));
    const [known, empty] = [rows.filter((row) => !isEmpty(row)), rows.filter(isEmpty)];
    known.sort(order(rows, column));
    if (isFalling) known.reverse();
    for (const each of heading.parentElement.cells) each.removeAttribute("aria-sort");
    heading.setAttribute("aria-sort", isFalling ? "descending" : "ascending");
    table.tBodies[0].append(...known, ...empty);
  }

  for (const table of document.querySelectorAll("table.sortable")) {
    [...table.tHead.rows[0].cells].forEach((heading, column) => {
      const button = document.createElement("button");
      button.type = "button";
      button.append(...heading.childNodes);
      button.addEventListener("click", () => sort(table, heading, column));
      heading.append(button);
    });
  }
})();
