// Names come from data sets: they are only ever set as text.
const assets = LIBRARY.rows.map(row => Object.fromEntries(LIBRARY.fields.map((name, at) => [name, row[at]])));
const SIDES = ["front", "left", "top", "right", "rear"];
const AZIMUTHS = { front: 0, left: 2, rear: 4, right: 6 };  // in eighths of a turn
const SIZES = [["under 1 m", 0], ["1 to 3 m", 1], ["3 to 5 m", 3], ["5 to 8 m", 5], ["8 m and more", 8]];
const sizeOf = asset => asset.length_m == null ? "none" : SIZES.findLast(([, from]) => asset.length_m >= from)[0];
const FACETS = { kind: a => a.kind, category: a => a.category ?? "none", size: sizeOf, style: a => a.style ?? "as recorded",
                 dataset: a => a.dataset ?? "none", licence: a => a.licence ?? "none" };
const SLIDERS = { score: "Score at least", coverage: "Directions seen at least" };
const SORTS = { "best first": ["score", -1], "most seen": ["coverage", -1], "largest first": ["length_m", -1],
                "smallest first": ["length_m", 1], "sharpest first": ["psnr_db", -1], "by name": ["name", 1] };
const chosen = Object.fromEntries([...Object.keys(FACETS), "sides"].map(name => [name, new Set()]));
const least = { score: 0, coverage: 0 }, byId = id => document.getElementById(id);
const cards = new Map();  // of what is in view, by position
let shown = [], words = [], chips = false, columns = 1, size = [200, 200], turning = null;

for (const asset of assets) asset.words = [asset.name, asset.category, asset.asset_id, asset.actor_id, asset.run_id, asset.style,
                                           ...asset.scene_ids ?? []].join(" ").toLowerCase();

function make(tag, className, text, parent) {
  const made = document.createElement(tag);
  if (className) made.className = className;
  if (text != null) made.textContent = text;
  parent?.append(made);
  return made;
}
const number = (value, digits, unit = "") => value == null ? "–" : value.toFixed(digits) + unit;
const extent = asset => asset.length_m == null ? "" :
  [asset.length_m, asset.width_m, asset.height_m].filter(side => side != null).map(side => side.toFixed(1)).join(" × ") + " m";

function passes(asset, but) {
  return Object.entries(FACETS).every(([name, value]) => name === but || !chosen[name].size || chosen[name].has(value(asset)))
    && [...chosen.sides].every(side => asset.sides?.includes(side))
    && Object.entries(least).every(([name, value]) => !value || asset[name] >= value)
    && words.every(word => asset.words.includes(word));
}
function update() {
  words = byId("text").value.toLowerCase().split(/\s+/).filter(Boolean);
  const [name, sign] = SORTS[byId("sort").value];
  const order = (a, b) => (a[name] == null) - (b[name] == null) || (a[name] > b[name] ? sign : a[name] < b[name] ? -sign : 0);
  shown = assets.filter(asset => passes(asset)).sort(order);
  byId("count").textContent = `${shown.length.toLocaleString("en")} of ${assets.length.toLocaleString("en")}`;
  for (const [facet, value] of Object.entries(FACETS)) {
    const counts = new Map();
    for (const asset of assets) if (passes(asset, facet)) counts.set(value(asset), (counts.get(value(asset)) ?? 0) + 1);
    for (const chip of byId(facet).children) {
      const count = counts.get(chip.dataset.value) ?? 0;
      chip.lastChild.textContent = " " + count.toLocaleString("en");
      chip.classList.toggle("none", !count);
    }
  }
  relayout();
}
function filters() {
  const box = byId("filters");
  const group = (title, id) => (make("h2", "", title, box), Object.assign(make("div", "chips", null, box), { id }));
  const chip = (set, value, parent, text = value) => {
    const button = make("button", "", text, parent);
    Object.assign(button.dataset, { value });
    button.ariaPressed = "false";
    button.onclick = () => {
      button.ariaPressed = String(!set.delete(value) && !!set.add(value));
      if (innerWidth > 760) scrollTo(0, 0);
      if (chips) update();
    };
    make("small", "", "", button);
  };
  for (const [facet, value] of Object.entries(FACETS)) {
    const order = [...SIZES.map(([name]) => name), "none"], values = [...new Set(assets.map(value))];
    if (values.length < 2) { delete FACETS[facet]; continue; }
    const parent = group(facet[0].toUpperCase() + facet.slice(1), facet);
    values.sort((a, b) => order.indexOf(a) - order.indexOf(b) || String(a).localeCompare(String(b)));
    for (const one of values) chip(chosen[facet], one, parent);
  }
  byId("kind")?.querySelector("[data-value=actor]")?.click();
  const sides = group("Seen from", "sides");
  for (const side of SIDES) chip(chosen.sides, side, sides);
  make("h2", "", "Quality", box);
  for (const [name, title] of Object.entries(SLIDERS)) {
    const label = make("label", "", title, box), value = make("span", "", "0.00", label);
    const slider = Object.assign(make("input", "", null, box), { type: "range", min: 0, max: 1, step: 0.05, value: 0 });
    slider.ariaLabel = title;
    slider.oninput = () => { least[name] = +slider.value; value.textContent = least[name].toFixed(2); update(); };
  }
  for (const name of Object.keys(SORTS)) make("option", "", name, byId("sort"));
  box.open = innerWidth > 760;
}
function facing(asset) {  // the eighth of a turn from which it was seen best, or one in which much of it shows
  const turns = (asset.sides ?? []).filter(side => side in AZIMUTHS).map(side => AZIMUTHS[side] * Math.PI / 4);
  const [x, y] = [Math.cos, Math.sin].map(part => turns.reduce((sum, turn) => sum + part(turn), 0));
  return Math.hypot(x, y) < 0.1 ? 1 : Math.round(Math.atan2(y, x) * 4 / Math.PI);
}
function stage(asset, parent) {
  const made = make("div", "stage", asset.picture ? null : asset.kind, parent);
  if (asset.style) make("span", "tag", asset.style, made);
  if (!asset.picture) return made;
  const strip = Object.assign(make("img", "", null, made), { src: asset.picture, alt: asset.name ?? "", draggable: false });
  let azimuth = asset.kind === "actor" ? facing(asset) : 0, from = null, timer = null;
  made.turn = (steps = 1) => {  // a strip of pictures of 4 by 3, side by side
    if (!made.isConnected) clearInterval(timer);
    const count = Math.max(1, Math.floor(strip.naturalWidth / strip.naturalHeight * 0.75 + 0.01));
    azimuth = ((azimuth + steps) % count + count) % count;
    strip.style.transform = `translateX(${-100 * azimuth / count}%)`;
  };
  strip.onload = () => made.turn(0);
  made.onpointerenter = event => { if (event.pointerType === "mouse") timer ??= setInterval(made.turn, 250); };
  made.onpointerleave = () => { clearInterval(timer); timer = from = null; };
  made.onpointerdown = event => { from = event.clientX; made.dragged = false; clearInterval(timer); };
  made.onpointermove = event => {
    const steps = from == null ? 0 : Math.trunc((event.clientX - from) / 18);
    if (steps) { made.turn(-steps); from += 18 * steps; made.dragged = true; }
  };
  made.onpointerup = () => { from = null; };
  return made;
}
const ORIGINS = ["seen", "mirrored", "guessed"];
function origins(asset) {  // where its Gaussians come from, if not all were seen
  const parts = ORIGINS.filter(name => asset[`${name}_share`] > 0.005);
  if (!parts.length || parts.join() === "seen") return "";
  return parts.map(name => `${Math.round(100 * asset[`${name}_share`])} % ${name}`).join(", ");
}
function card(asset) {
  const made = make("div", "card");
  Object.assign(made, { tabIndex: 0, role: "button" });
  made.stage = stage(asset, made);
  make("i", "", null, make("div", "bar", null, made)).style.width = `${100 * (asset.score ?? 0)}%`;
  const said = make("div", "said", null, made);
  make("b", "", asset.name || asset.category, said).title = asset.name ?? "";
  if (asset.score != null) make("span", "score", number(asset.score, 2), said).title = "score";
  if (asset.sides?.length) {  // from above, the front ahead
    const sides = make("span", "sides", null, said), colour = side => `var(--${asset.sides.includes(side) ? "accent" : "line"})`;
    sides.style.borderColor = ["front", "right", "rear", "left"].map(colour).join(" ");
    if (asset.sides.includes("top")) sides.style.background = "color-mix(in srgb, var(--accent) 45%, transparent)";
    sides.title = "seen from " + asset.sides.join(", ");
  }
  make("span", "soft", [extent(asset) || asset.category, origins(asset)].filter(Boolean).join(" · "), said);
  made.onclick = () => { if (!made.stage.dragged) open(asset); made.stage.dragged = false; };
  made.onkeydown = event => { if (event.key === "Enter") open(asset); };
  return made;
}
function open(asset) {
  const detail = byId("detail");
  detail.replaceChildren();
  const form = Object.assign(make("form", "", null, detail), { method: "dialog" });
  make("h3", "", asset.name || asset.category, form);
  make("button", "", "Close", form);
  const both = make("div", "both", null, detail);
  stage(asset, both);
  const table = make("table", "", null, both);
  const facts = { id: asset.asset_id, kind: asset.kind, category: asset.category, size: extent(asset), style: asset.style,
    "seen from": asset.sides?.join(", "), "directions seen": number(asset.coverage, 2), "of its surface": origins(asset), score: number(asset.score, 2),
    PSNR: number(asset.psnr_db, 1, " dB"), LPIPS: number(asset.lpips, 3), images: asset.num_views,
    Gaussians: asset.num_gaussians?.toLocaleString("en"), "LiDAR points": asset.num_points?.toLocaleString("en"),
    sightings: asset.num_sightings, "made of": asset.fused_from && `fused from ${asset.fused_from.length} sightings`,
    scenes: asset.scene_ids?.join(", "), dataset: asset.dataset, licence: asset.licence };
  for (const [name, value] of Object.entries(facts)) {
    if (value == null || value === "" || value === "–") continue;
    const row = make("tr", "", null, table);
    make("th", "", name, row); make("td", "", value, row);
  }
  make("code", "", `lidarpainter assets show ${asset.asset_id}`, detail);
  detail.showModal();
}
function relayout() {  // cards of one size; only those in view are in the page
  const grid = byId("grid"), width = grid.clientWidth, gap = 12;
  columns = Math.max(innerWidth > 760 ? 1 : 2, Math.floor((width + gap) / (208 + gap)));
  const across = (width - gap * (columns - 1)) / columns;
  size = [across + gap, Math.round(across * 0.75) + 58 + gap];
  grid.style.height = `${Math.ceil(shown.length / columns) * size[1]}px`;
  cards.forEach(one => one.remove()); cards.clear(); byId("empty")?.remove();
  if (!shown.length) make("div", "", "Nothing passes these filters.", grid).id = "empty";
  inView();
}
function inView() {
  const top = -byId("grid").getBoundingClientRect().top, row = pixels => Math.floor(pixels / size[1]);
  const first = Math.max(0, row(top - 300)) * columns, end = (row(top + innerHeight + 300) + 1) * columns;
  for (const [at, one] of cards) if (at < first || at >= end) { one.remove(); cards.delete(at); }
  for (let at = first; at < Math.min(end, shown.length); at++) if (!cards.has(at)) {
    const one = card(shown[at]);
    Object.assign(one.style, { width: `${size[0] - 12}px`, left: `${at % columns * size[0]}px`,
                               top: `${Math.floor(at / columns) * size[1]}px` });
    cards.set(at, one); byId("grid").append(one);
  }
}
filters(); chips = true; update();
byId("text").oninput = byId("sort").onchange = () => { scrollTo(0, 0); update(); };
byId("turn").onclick = () => {
  turning = turning ? clearInterval(turning) : setInterval(() => cards.forEach(one => one.stage.turn?.()), 300);
  byId("turn").ariaPressed = String(!!turning);
};
addEventListener("scroll", inView, { passive: true });
addEventListener("resize", relayout);
