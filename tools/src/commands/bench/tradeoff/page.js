let shown = null;
function show(panel) {
  if (shown) shown.hidden = true;
  shown = panel;
  if (shown) shown.hidden = false;
}
for (const kind of ["pointerover", "click"]) {
  document.addEventListener(kind, ({ target }) => {
    const point = target.closest("[data-point]");
    if (point) show(document.getElementById("p" + point.dataset.point));
    else if (kind === "click" && !target.closest(".panel")) show(null);
  });
}
