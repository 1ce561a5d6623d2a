// Shows the line that hangs on the mark nearest to the pointer.
(() => {
  "use strict";
  const REACH = 16; // px
  const box = document.getElementById("tip");
  let pointed = null;

  function release() {
    if (pointed) pointed.classList.remove("pointed");
    pointed = null;
    box.hidden = true;
  }

  function nearest(marks, x, y) {
    let best = null, least = REACH * REACH;
    for (const mark of marks) {
      const area = mark.getBoundingClientRect();
      const dx = (area.left + area.right) / 2 - x, dy = (area.top + area.bottom) / 2 - y;
      if (dx * dx + dy * dy < least) [best, least] = [mark, dx * dx + dy * dy];
    }
    return best;
  }

  for (const drawing of document.querySelectorAll(".drawing")) {
    const marks = [...drawing.querySelectorAll("[data-tip]")];
    if (!marks.length) continue;
    drawing.addEventListener("pointermove", (event) => {
      const mark = nearest(marks, event.clientX, event.clientY);
      if (mark === pointed) return;
      release();
      if (!mark) return;
      pointed = mark;
      mark.classList.add("pointed");
      box.textContent = mark.dataset.tip;
      box.hidden = false;
      const at = mark.getBoundingClientRect();
      const left = Math.min(at.right + 8, innerWidth - box.offsetWidth - 8);
      box.style.left = `${Math.max(8, left)}px`;
      box.style.top = `${Math.max(8, at.top - box.offsetHeight - 10)}px`;
    });
    drawing.addEventListener("pointerleave", release);
  }
  addEventListener("scroll", release, { passive: true });
})();
