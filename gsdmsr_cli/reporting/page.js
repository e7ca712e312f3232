// The divider between the true and the drawn picture follows its range control.
for (const control of document.querySelectorAll(".compare input")) {
  const follow = () => control.parentElement.style.setProperty("--at", `${control.value}%`);
  control.addEventListener("input", follow);
  follow();
}
