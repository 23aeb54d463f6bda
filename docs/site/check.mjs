// Looks at the built site in a browser, as people with a mouse, a keyboard or a reader do.
//
//   mkdir -p /tmp/check && cd /tmp/check && npm install playwright-core axe-core
//   node REPOSITORY/docs/site/check.mjs REPOSITORY/build/site [--shots FOLDER] [--only TEXT]
//
// --only TEXT looks at the pages whose names hold it; --only none at none, but asks the questions.
//
// Chromium is that of the system (CHROMIUM=/usr/bin/chromium). Every page is opened by http and from
// the disk, at three widths, light and dark; the exit status is 1 if anything is amiss.
import { createRequire } from "node:module";
import { createServer } from "node:http";
import { mkdirSync, readFileSync, readdirSync, statSync } from "node:fs";
import { dirname, extname, join, relative, resolve } from "node:path";
import { fileURLToPath, pathToFileURL } from "node:url";

const require = createRequire(join(process.cwd(), "x.js"));
const { chromium } = require("playwright-core");
const axe = readFileSync(require.resolve("axe-core/axe.min.js"), "utf8");

const site = resolve(process.argv[2] ?? "build/site");
const option = (name) => {
  const i = process.argv.indexOf(name);
  return i < 0 ? "" : process.argv[i + 1];
};
const [shots, only] = [option("--shots"), option("--only")];
const asked = JSON.parse(
  readFileSync(join(dirname(fileURLToPath(import.meta.url)), "questions.json"), "utf8"));
const faults = [];
const fault = (where, what) => {
  faults.push(`${where}: ${what}`);
  console.log(`FAULT ${where}: ${what}`);
};

function walk(folder) {
  return readdirSync(folder).flatMap((name) => {
    const path = join(folder, name);
    if (statSync(path).isDirectory()) return name.startsWith("_") ? [] : walk(path);
    return name.endsWith(".html") ? [relative(site, path)] : [];
  });
}
const pages = walk(site).filter((x) => x.includes(only)).sort();

const TYPES = {
  ".html": "text/html", ".js": "text/javascript", ".css": "text/css", ".svg": "image/svg+xml",
  ".png": "image/png", ".json": "application/json",
};
const server = createServer((request, response) => {
  const path = join(site, decodeURIComponent(new URL(request.url, "http://x").pathname));
  try {
    const body = readFileSync(path);
    response.writeHead(200, { "content-type": TYPES[extname(path)] ?? "application/octet-stream" });
    response.end(body);
  } catch {
    response.writeHead(404);
    response.end();
  }
});
await new Promise((done) => server.listen(0, "127.0.0.1", done));
const here = `http://127.0.0.1:${server.address().port}/`;
const disk = `${pathToFileURL(site).href}/`;

const browser = await chromium.launch({
  executablePath: process.env.CHROMIUM ?? "/usr/bin/chromium",
  args: ["--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run",
    "--disable-background-networking", "--disable-component-update", "--disable-sync"],
});

async function open(scheme) {
  const context = await browser.newContext({ colorScheme: scheme, reducedMotion: "reduce" });
  const page = await context.newPage();
  page.on("console", (m) => m.type() === "error" && fault(page.url(), `console: ${m.text()}`));
  page.on("pageerror", (e) => fault(page.url(), `script: ${e.message}`));
  page.on("request", (r) => {
    if (!r.url().startsWith(here) && !r.url().startsWith("file:") && !r.url().startsWith("data:"))
      fault(page.url(), `asks for ${r.url()}`);
  });
  page.on("response", (r) => r.status() >= 400 && fault(page.url(), `${r.status()} ${r.url()}`));
  return page;
}

const WIDTHS = [390, 1280, 1920];

async function look(page, name, scheme, base) {
  await page.goto(base + name);
  for (const width of base === here ? WIDTHS : [390]) {
    const where = `${name} at ${width} ${scheme}`;
    await page.setViewportSize({ width, height: 900 });
    const wide = await page.evaluate(() => document.documentElement.scrollWidth - innerWidth);
    if (wide > 0) {
      const what = await page.evaluate(() => [...document.querySelectorAll("body *")]
        .filter((x) => x.getBoundingClientRect().right > innerWidth + 1).slice(-1)
        .map((x) => x.outerHTML.slice(0, 160))[0]);
      fault(where, `${wide} pixels too wide: ${what}`);
    }
    if (shots && base === here) {
      mkdirSync(shots, { recursive: true });
      await page.screenshot({ path: join(shots, `${name.replaceAll("/", "_")}-${width}-${scheme}.png`) });
    }
    if (base === here && width === (scheme === "light" ? 390 : 1280)) {
      await page.evaluate(axe);
      const found = await page.evaluate(() => window.axe.run(document, {
        runOnly: ["wcag2a", "wcag2aa", "wcag21a", "wcag21aa", "wcag22aa", "best-practice"],
      }));
      for (const x of found.violations)
        fault(where, `axe ${x.id} (${x.nodes.length}): ${x.nodes[0].html.slice(0, 200)} ` +
          `${x.nodes[0].any[0]?.message ?? x.help}`);
    }
  }
  const pictures = await page.evaluate(() => [...document.images]
    .filter((x) => !x.hasAttribute("alt") || x.alt === "" || (x.complete && !x.naturalWidth))
    .map((x) => x.outerHTML.slice(0, 160)));
  for (const x of pictures) fault(`${name} ${scheme}`, `a picture without text or content: ${x}`);
}

async function search(page, base, query, expected, most = 10) {
  await page.goto(`${base}search.html?q=${encodeURIComponent(query)}`);
  await page.waitForSelector("#search-results .search-summary, #search-results p", { timeout: 20000 });
  await page.waitForTimeout(600);
  const found = await page.$$eval("#search-results li a", (all) => all.map((x) => x.href));
  const rank = found.findIndex((x) => x.includes(expected));
  if (rank < 0 || rank >= most)
    fault(`search "${query}"`, `${expected} is not among the first ${most}; first is ${found[0]}`);
  return rank + 1;
}

// Everything that can be used is reached by Tab alone, the way past the navigation first.
async function keyboard(page) {
  await page.setViewportSize({ width: 1280, height: 900 });
  await page.goto(here + "docs/start.html");
  await page.keyboard.press("Tab");
  const first = await page.evaluate(() => document.activeElement.textContent.trim());
  if (!/skip/i.test(first)) fault("keyboard", `the first stop is ${first}, no way to the content`);
  await page.keyboard.press("Enter");
  await page.keyboard.press("Tab");
  const inside = await page.evaluate(() => !!document.activeElement.closest("article, [role=main]"));
  if (!inside) fault("keyboard", "the way to the content does not lead there");
  await page.goto(here + "docs/start.html");
  const all = await page.evaluate(() => {
    const kinds = "a[href], button, input:not([type=hidden]), summary, [tabindex='0']";
    const seen = [...document.querySelectorAll(kinds)].filter((x) =>
      x.checkVisibility({ visibilityProperty: true }) && !x.disabled && x.tabIndex >= 0);
    seen.forEach((x, i) => (x.dataset.stop = i));
    return seen.map((x) => x.outerHTML.slice(0, 120));
  });
  const reached = new Set();
  for (let i = 0; i < all.length + 20; i++) {
    await page.keyboard.press("Tab");
    const [stop, shown] = await page.evaluate(() => {
      const x = document.activeElement;
      const style = getComputedStyle(x);
      return [x.dataset.stop, style.outlineStyle !== "none" || style.boxShadow !== "none"];
    });
    if (stop === undefined) continue;
    if (!shown) fault("keyboard", `no outline: ${all[stop]}`);
    reached.add(Number(stop));
  }
  const lost = all.filter((_, i) => !reached.has(i));
  for (const x of lost) fault("keyboard", `is not reached: ${x}`);
  const themes = new Set();
  const button = page.locator(".theme-toggle:visible").first();
  for (let i = 0; i < 3; i++) {
    await button.focus();
    await page.keyboard.press("Enter");
    themes.add(await page.evaluate(() => document.body.dataset.theme));
  }
  if (themes.size < 3) fault("keyboard", `the switch gives ${[...themes]} only`);
  await page.goto(here + "docs/start.html");
  await page.locator("input[name=q]:visible").first().focus();
  await page.keyboard.type("certificate");
  await page.keyboard.press("Enter");
  await page.waitForSelector("#search-results li a");
  console.log(`keyboard: ${reached.size} of ${all.length} stops, themes ${[...themes]}`);
}

// On a telephone the two drawers open and close.
async function drawers(page) {
  await page.setViewportSize({ width: 390, height: 900 });
  await page.goto(here + "docs/start.html");
  await page.locator(".mobile-header label.nav-overlay-icon, .mobile-header [for=__navigation]").first().click();
  await page.waitForTimeout(400);
  if (!(await page.locator(".sidebar-drawer a >> visible=true").count()))
    fault("drawers", "the navigation does not open");
}

async function answered(page, { question, search: query, clicks, page: expected, text }) {
  let way;
  if (query) {
    way = `search "${query}", result ${await search(page, here, query, expected)}`;
    await page.locator(`#search-results li a[href*="${expected}"]`).first().click();
  } else {
    await page.setViewportSize({ width: 1280, height: 900 });
    await page.goto(here + "docs/index.html");
    for (const name of clicks)
      await page.getByRole("link", { name, exact: true }).first().click({ timeout: 5000 });
    way = `${clicks.length} clicks: ${clicks.join(" > ")}`;
  }
  await page.waitForLoadState();
  const content = (await page.locator("article").innerText()).replaceAll(/\s+/g, " ");
  const arrived = new URL(page.url()).pathname;
  if (!arrived.includes(expected) || !content.includes(text))
    fault(`"${question}"`, `${way} ends at ${arrived}, without "${text}"`);
  else console.log(`answered: ${question} (${way}) -> ${expected}`);
}

for (const scheme of ["light", "dark"]) {
  const page = await open(scheme);
  for (const name of pages) await look(page, name, scheme, here);
  if (scheme === "light") for (const name of pages) await look(page, name, "light, from the disk", disk);
  await page.context().close();
}
console.log(`${pages.length} pages at ${WIDTHS} pixels, light and dark`);
const page = await open("light");
if (!only || only === "none") {
  await keyboard(page);
  await drawers(page);
  for (const base of [here, disk]) {
    for (const [most, asks] of [[10, asked.searches], [1, asked.first]])
      for (const [query, expected] of Object.entries(asks)) {
        const rank = await search(page, base, query, expected, most);
        console.log(`search ${base.slice(0, 4)} "${query}": result ${rank} is ${expected}`);
      }
  }
  for (const x of asked.questions) {
    await answered(page, x).catch((e) => fault(`"${x.question}"`, e.message.split("\n")[0]));
  }
}
await browser.close();
server.close();
console.log(faults.length ? `${faults.length} faults` : "no faults");
process.exit(faults.length ? 1 : 0);
