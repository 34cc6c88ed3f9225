"use strict";
// Sortable tables, the choice of the order that tables and charts show, and the copy button.
(() => {
  document.documentElement.classList.add("js");

  const keyOf = (row, column) => {
    // A row without numbers spans them all.
    const cell = row.cells.length > column ? row.cells[column] : null;
    if (!cell || cell.dataset.key === undefined) return null;
    const key = cell.dataset.key;
    const isText = column === 0 || cell.classList.contains("text");
    return isText ? key : Number(key);
  };

  const compare = (a, b) =>
    typeof a === "string" ? a.localeCompare(b, undefined, { numeric: true }) : a - b;

  const sort = (table, column, descending) => {
    for (const body of table.tBodies) {
      const rows = [...body.rows].filter((row) => !row.classList.contains("of-order"));
      const keyed = rows.map((row) => [keyOf(row, column), row]);
      keyed.sort(([a], [b]) => {
        // Missing values come last in either direction.
        if (a === null || b === null) return (a === null) - (b === null);
        return descending ? compare(b, a) : compare(a, b);
      });
      body.append(...keyed.map(([, row]) => row));
    }
    [...table.tHead.rows[0].cells].forEach((cell, i) => {
      cell.setAttribute("aria-sort", i !== column ? "none" : descending ? "descending" : "ascending");
    });
  };

  for (const table of document.querySelectorAll("table.sortable")) {
    [...table.tHead.rows[0].cells].forEach((cell, column) => {
      cell.querySelector("button").addEventListener("click", () => {
        sort(table, column, cell.getAttribute("aria-sort") === "ascending");
      });
    });
  }

  const names = JSON.parse(document.getElementById("data").textContent).orders;

  const show = (order) => {
    for (const body of document.querySelectorAll("tbody[data-order]")) {
      body.hidden = Number(body.dataset.order) !== order;
    }
    for (const name of document.querySelectorAll(".current-order b")) name.textContent = names[order];
    document.dispatchEvent(new CustomEvent("order", { detail: order }));
  };

  for (const control of document.querySelectorAll("input[name=order], #order")) {
    control.addEventListener("change", () => show(Number(control.value)));
  }
  // A browser that returns to the page may have kept another choice than the first.
  const chosen = document.querySelector("input[name=order]:checked, #order");
  show(chosen ? Number(chosen.value) : 0);

  const copy = document.getElementById("copy");
  copy.addEventListener("click", async () => {
    const text = document.getElementById("study");
    try {
      await navigator.clipboard.writeText(text.textContent);
      copy.textContent = "Copied";
    } catch {
      getSelection().selectAllChildren(text);
      copy.textContent = "Selected";
    }
    setTimeout(() => { copy.textContent = "Copy"; }, 2000);
  });
})();
