// Cards are Markdown: headings, paragraphs, lists, tables, code, emphasis and links become elements. Everything else is
// shown as it is written; nothing is ever read as HTML.

import { h } from "./dom.js";

export function markdown(text) {
  const blocks = [];
  const lines = text.split("\n");
  let at = 0;
  const take = (matches) => {
    const start = at;
    while (at < lines.length && matches(lines[at])) at++;
    return lines.slice(start, at);
  };
  while (at < lines.length) {
    const line = lines[at];
    const heading = /^(#{1,6})\s+(.*)$/.exec(line);
    if (!line.trim()) at++;
    else if (heading) {
      // The page has its own first and second headings.
      blocks.push(h(`h${Math.min(heading[1].length + 2, 6)}`, {}, inline(heading[2])));
      at++;
    } else if (line.startsWith("```")) {
      at++;
      blocks.push(h("pre", { tabIndex: 0 }, h("code", {}, take((next) => !next.startsWith("```")).join("\n"))));
      at++;
    } else if (line.startsWith("|")) blocks.push(table(take((next) => next.startsWith("|"))));
    else if (/^\s*[-*] /.test(line)) {
      const items = take((next) => /^\s*[-*] /.test(next) || /^\s+\S/.test(next));
      blocks.push(h("ul", {}, items.map((item) => h("li", {}, inline(item.replace(/^\s*[-*] /, ""))))));
    } else blocks.push(h("p", {}, inline(take((next) => next.trim() && !/^(#|\||```|\s*[-*] )/.test(next)).join(" "))));
  }
  return blocks;
}

function table(lines) {
  const cells = (line) => line.split("|").slice(1, -1).map((cell) => cell.trim());
  const rule = (line) => /^\|[\s:|-]*-[\s:|-]*\|$/.test(line.trim());
  const [head, ...rows] = lines.filter((line) => !rule(line)).map(cells);
  return h(
    "div",
    { className: "scroll", tabIndex: 0, role: "region", "aria-label": "Table" },
    h(
      "table",
      {},
      head.some(Boolean) ? h("thead", {}, h("tr", {}, head.map((cell) => h("th", { scope: "col" }, inline(cell))))) : null,
      h("tbody", {}, rows.map((row) => h("tr", {}, row.map((cell, column) => (column ? h("td", {}, inline(cell)) : h("th", { scope: "row" }, inline(cell))))))),
    ),
  );
}

function inline(text) {
  const parts = [];
  const pattern = /`([^`]+)`|\*\*([^*]+)\*\*|\*([^*]+)\*|\[([^\]]+)\]\(([^)\s]+)\)/g;
  let from = 0;
  for (const match of text.matchAll(pattern)) {
    parts.push(text.slice(from, match.index));
    const [whole, code, strong, weak, label, address] = match;
    if (code) parts.push(h("code", {}, code));
    else if (strong) parts.push(h("strong", {}, strong));
    else if (weak) parts.push(h("em", {}, weak));
    else if (/^https?:\/\//.test(address)) parts.push(h("a", { href: address, rel: "noreferrer" }, label));
    else parts.push(label);
    from = match.index + whole.length;
  }
  return [...parts, text.slice(from)].filter(Boolean);
}
