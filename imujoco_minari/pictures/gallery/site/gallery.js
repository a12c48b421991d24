"use strict";

// Storage and history may be refused to pages opened as files; nothing here depends on them.
function attempt(action) {
  try {
    return action();
  } catch {
    return undefined;
  }
}

function startTheme() {
  const root = document.documentElement;
  const kept = attempt(() => localStorage.getItem("theme"));
  if (kept === "dark" || kept === "light") root.dataset.theme = kept;
  document.getElementById("theme").addEventListener("click", () => {
    const system = matchMedia("(prefers-color-scheme: dark)").matches ? "dark" : "light";
    root.dataset.theme = (root.dataset.theme || system) === "dark" ? "light" : "dark";
    attempt(() => localStorage.setItem("theme", root.dataset.theme));
  });
}

function startFilters(form) {
  const list = document.getElementById("cards");
  const cards = [...list.children];
  const fields = ["q", "robot", "category", "body", "percent", "sort"];
  const orders = {
    "": (a, b) => a.dataset.order - b.dataset.order,
    high: (a, b) => b.dataset.return - a.dataset.return,
    low: (a, b) => a.dataset.return - b.dataset.return,
    "high-normalised": (a, b) => b.dataset.normalised - a.dataset.normalised,
    "low-normalised": (a, b) => a.dataset.normalised - b.dataset.normalised,
    name: (a, b) => a.dataset.words.localeCompare(b.dataset.words),
  };
  let sorted = "";

  // A variant with several changes has several bodies and percents.
  function values(card, name) {
    return card.dataset[name].split(" ");
  }

  function matches(card, wanted, without) {
    const words = wanted.q.toLowerCase().replaceAll("-", "−").split(/\s+/).filter(Boolean);
    const text = card.dataset.words.replaceAll("-", "−");
    return (
      words.every((word) => text.includes(word)) &&
      ["robot", "category", "body", "percent"].every(
        (name) => name === without || !wanted[name] || values(card, name).includes(wanted[name]),
      )
    );
  }

  // Disables the choices that no variant has under the other filters.
  function offer(name, wanted) {
    const left = new Set(cards.filter((card) => matches(card, wanted, name)).flatMap((card) => values(card, name)));
    for (const option of form.elements[name].options) {
      option.disabled = option.value !== "" && option.value !== wanted[name] && !left.has(option.value);
    }
  }

  function ofAll(kind) {
    return `${kind.filter((card) => !card.hidden).length} of ${kind.length}`;
  }

  function show() {
    const wanted = Object.fromEntries(fields.map((name) => [name, form.elements[name].value]));
    for (const card of cards) card.hidden = !matches(card, wanted);
    if (wanted.sort !== sorted) {
      list.append(...[...cards].sort(orders[wanted.sort]));
      sorted = wanted.sort;
    }
    for (const name of ["robot", "category", "body", "percent"]) offer(name, wanted);
    document.getElementById("none").hidden = cards.some((card) => !card.hidden);
    const variants = cards.filter((card) => card.dataset.category !== "base");
    const bases = cards.filter((card) => card.dataset.category === "base");
    document.getElementById("count").textContent = `${ofAll(variants)} variants, ${ofAll(bases)} bases`;
    const kept = new URLSearchParams(fields.filter((name) => wanted[name]).map((name) => [name, wanted[name]]));
    attempt(() => history.replaceState(null, "", kept.size ? `#${kept}` : location.pathname + location.search));
    attempt(() => sessionStorage.setItem("filters", kept.toString()));
  }

  function read() {
    const kept = new URLSearchParams(location.hash.slice(1));
    for (const name of fields) form.elements[name].value = kept.get(name) ?? "";
    for (const name of fields.slice(1)) if (form.elements[name].selectedIndex < 0) form.elements[name].value = "";
    show();
  }

  form.addEventListener("input", show);
  form.addEventListener("submit", (event) => event.preventDefault());
  form.addEventListener("reset", () => setTimeout(show));
  addEventListener("hashchange", read);
  read();
}

async function copyText(text) {
  // Only secure pages have the clipboard's own interface.
  if (navigator.clipboard) {
    try {
      await navigator.clipboard.writeText(text);
      return true;
    } catch {}
  }
  const area = document.createElement("textarea");
  area.value = text;
  area.className = "hidden";
  document.body.append(area);
  area.select();
  const done = attempt(() => document.execCommand("copy"));
  area.remove();
  return Boolean(done);
}

function startCopying() {
  const said = document.getElementById("said");
  for (const button of document.querySelectorAll(".copy")) {
    button.addEventListener("click", async () => {
      const code = button.parentElement.querySelector("code");
      const done = await copyText(code.textContent);
      button.focus();
      button.textContent = done ? "Copied" : "Select it";
      said.textContent = done ? "Copied to the clipboard" : "Copying is not allowed here";
      setTimeout(() => {
        button.textContent = "Copy";
        said.textContent = "";
      }, 2000);
    });
  }
}

function startVideos() {
  const both = document.getElementById("both");
  both?.addEventListener("click", () => {
    for (const video of document.querySelectorAll("video")) {
      video.currentTime = 0;
      attempt(() => video.play().catch(() => {}));
    }
  });
  // Back to the list as it was filtered.
  const back = document.getElementById("back");
  const kept = attempt(() => sessionStorage.getItem("filters"));
  if (back && kept) back.href += `#${kept}`;
}

startTheme();
const form = document.getElementById("filters");
if (form) startFilters(form);
else {
  startCopying();
  startVideos();
}
