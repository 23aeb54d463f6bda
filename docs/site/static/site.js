// What the theme leaves out for keyboards and readers of screens.
// From the disk no page may read another, and the search does without excerpts.
if (location.protocol === "file:" && typeof DOCUMENTATION_OPTIONS !== "undefined")
  DOCUMENTATION_OPTIONS.SHOW_SEARCH_SUMMARY = false;

function tell() {
  const results = document.querySelector("#search-results");
  if (results && !document.querySelector("h1"))
    results.before(Object.assign(document.createElement("h1"), { textContent: "Search" }));
  document.querySelector(".sidebar-drawer")?.setAttribute("aria-label", "All pages");
  document.querySelector(".toc-drawer")?.setAttribute("aria-label", "On this page");
  for (const box of document.querySelectorAll("pre, .table-wrapper, .math-block, dt.sig, .output")) {
    if (box.scrollWidth > box.clientWidth) box.tabIndex = 0;
    else box.removeAttribute("tabindex");
  }
}
document.addEventListener("DOMContentLoaded", tell);
window.addEventListener("load", tell);
window.addEventListener("resize", tell);
