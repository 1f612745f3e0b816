// The view as a PNG that can be measured in: with its scale, the step of the grid, the time and the meaning of colours.

const LINE_PX = 18;
const MARGIN_PX = 12;

/** Save what the canvas shows, with lines of text below and a scale bar in the corner. */
export function save(stage, lines, name) {
  stage.draw();
  const { canvas } = stage;
  const ratio = canvas.width / canvas.clientWidth;
  const style = getComputedStyle(document.body);
  const sheet = document.createElement("canvas");
  sheet.width = canvas.width;
  sheet.height = canvas.height + Math.round((lines.length * LINE_PX + 2 * MARGIN_PX) * ratio);
  const pen = sheet.getContext("2d");
  pen.fillStyle = style.backgroundColor;
  pen.fillRect(0, 0, sheet.width, sheet.height);
  pen.drawImage(canvas, 0, 0);
  pen.scale(ratio, ratio);
  pen.fillStyle = pen.strokeStyle = style.color;
  pen.font = `13px ${style.fontFamily}`;
  const bottom = canvas.clientHeight;
  lines.forEach((line, place) => pen.fillText(line, MARGIN_PX, bottom + MARGIN_PX + (place + 0.7) * LINE_PX));
  const { length_m, pixels } = stage.scale();
  pen.lineWidth = 2;
  pen.beginPath();
  pen.moveTo(MARGIN_PX, bottom - 20);
  pen.lineTo(MARGIN_PX, bottom - 14);
  pen.lineTo(MARGIN_PX + pixels, bottom - 14);
  pen.lineTo(MARGIN_PX + pixels, bottom - 20);
  pen.stroke();
  pen.fillText(`${length_m} m`, MARGIN_PX, bottom - 26);
  sheet.toBlob((blob) => {
    const link = document.createElement("a");
    link.href = URL.createObjectURL(blob);
    link.download = name;
    link.click();
    setTimeout(() => URL.revokeObjectURL(link.href), 10000);
  }, "image/png");
}
