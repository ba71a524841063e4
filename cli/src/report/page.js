// Pictures grow when they are clicked, and test views change their order.
document.addEventListener('click', ({ target }) => { if (target.tagName === 'IMG') target.classList.toggle('large'); });
document.addEventListener('keydown', ({ key }) => {
  if (key === 'Escape') document.querySelectorAll('img.large').forEach(image => image.classList.remove('large'));
});
const panels = document.getElementById('panels'), order = document.getElementById('order');
if (panels) {
  const asTheyAre = [...panels.children];
  order.addEventListener('change', () => {
    const sign = Number(order.value);
    panels.append(...[...asTheyAre].sort((a, b) => sign * (a.dataset.psnr - b.dataset.psnr)));
  });
}
