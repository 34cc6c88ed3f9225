"use strict";
// Sortable tables, their CSV, the choice of the order that tables and charts show, and the copy button.
(() => {
  document.documentElement.classList.add("js");

  const keyOf = (row, column) => {
    // A row without numbers spans them all.
    const cell = row.cells.length > column ? row.cells[column] : null;
    if (!cell || cell.dataset.key === undefined) return null;
    const key = cell.dataset.key;
    const isText = column === 0 || cell.classList.contains("text");
    // Python spells infinity "inf".
    return isText ? key : Number(key.replace("inf", "Infinity"));
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

  const data = JSON.parse(document.getElementById("data").textContent);

  // A spreadsheet would take such a text for a formula, and run it.
  const harmless = (text) => (/^[=+\-@＝＋－＠]/.test(text) ? `'${text}` : text);
  const field = (text) => (/[",\n\r]/.test(text) ? `"${text.replaceAll('"', '""')}"` : text);

  // All orders of a table, with all digits, and the names of columns that the package uses.
  const csvOf = (table) => {
    const heads = [...table.tHead.rows[0].cells];
    const bodies = [...table.tBodies];
    const hasOrders = bodies.some((body) => body.dataset.value !== undefined);
    const hasRemarks = table.querySelector("[data-remark], .mark") !== null;
    const names = heads.flatMap((head) => [head.dataset.name, head.dataset.second ?? []].flat());
    const lines = [[...(hasOrders ? ["order"] : []), ...names, ...(hasRemarks ? ["status"] : [])]];
    for (const body of bodies) {
      for (const row of body.rows) {
        if (row.classList.contains("of-order")) continue;
        const isWhole = row.cells.length === heads.length;
        const cells = heads.flatMap((head, i) => {
          const { key = "", second = "" } = isWhole || i === 0 ? row.cells[i].dataset : {};
          const isNumber = head.classList.contains("number");
          return [isNumber ? key : harmless(key), ...(head.dataset.second === undefined ? [] : [second])];
        });
        const remark = row.querySelector("[data-remark]")?.dataset.remark
          ?? [...row.querySelectorAll(".mark")].map((mark) => mark.textContent).join("; ");
        lines.push([...(hasOrders ? [body.dataset.value] : []), ...cells, ...(hasRemarks ? [harmless(remark)] : [])]);
      }
    }
    return lines.map((line) => `${line.map(field).join(",")}\n`).join("");
  };

  for (const button of document.querySelectorAll("button.csv")) {
    button.addEventListener("click", () => {
      const table = document.getElementById(button.dataset.table);
      const link = document.createElement("a");
      link.href = URL.createObjectURL(new Blob([csvOf(table)], { type: "text/csv" }));
      link.download = `${data.name}-${table.dataset.name}.csv`;
      link.click();
      URL.revokeObjectURL(link.href);
    });
  }

  const show = (order) => {
    for (const part of document.querySelectorAll("[data-order]")) part.hidden = Number(part.dataset.order) !== order;
    for (const name of document.querySelectorAll(".current-order b")) name.textContent = data.orders[order];
    document.dispatchEvent(new CustomEvent("order", { detail: order }));
  };

  for (const control of document.querySelectorAll("input[name=order], #order")) {
    control.addEventListener("change", () => show(Number(control.value)));
  }
  // A browser that returns to the page may have kept another choice than the first.
  const chosen = document.querySelector("input[name=order]:checked, #order");
  show(chosen ? Number(chosen.value) : 0);

  const copy = document.getElementById("copy");
  copy?.addEventListener("click", async () => {
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
