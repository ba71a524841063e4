"""Opens the page of `plenoxel view RUN` or `plenoxel train --view` in headless Chromium, at 800 x 600 pixels.

    python tests/browser/live.py ADDRESS FOLDER [--stop]

ADDRESS is what the program printed. The script prints the time of the first picture, the pictures a second while the mouse drags the scene, and every message of the
console. It saves screenshots in FOLDER: at rest, in the middle of the dragging, of each channel, and from the fourth camera. With `--stop` it also presses
"save a checkpoint" and "save and stop". It exits with 1 if the console had a message, or a request failed, before that.

Needs Playwright (`pip install playwright`) and Chromium (Debian's package `chromium`), which it does not install.
"""

import argparse
import pathlib
import shutil
import sys
import time

from playwright.sync_api import sync_playwright

# Seconds of dragging, and milliseconds after which a picture is sharp.
DRAG, REST = 5.0, 6000

# Lists the pictures that the page shows: the time in milliseconds, the width, the height.
COUNT = """
window.pictures = [];
const draw = CanvasRenderingContext2D.prototype.drawImage;
CanvasRenderingContext2D.prototype.drawImage = function (...arguments) {
  window.pictures.push([performance.now(), arguments[0].width, arguments[0].height]);
  return draw.apply(this, arguments);
};
"""


def first_picture(page, address):
    """Opens the page and waits for its first picture."""
    begin = time.time()
    page.goto(address)
    while not page.evaluate("window.pictures.length"):
        page.wait_for_timeout(20)
        if time.time() - begin > 60:
            sys.exit("no picture after 60 s")
    print(f"first picture: {time.time() - begin:.2f} s")


def drag(page, path):
    """Drags the scene, and prints how many pictures were shown in a second."""
    page.evaluate("window.pictures.length = 0")
    page.mouse.move(350, 400)
    page.mouse.down()
    begin, moves = time.time(), 0
    while time.time() - begin < DRAG:
        moves += 1
        page.mouse.move(350 + 2 * (moves % 60), 400 + moves % 30)
        page.wait_for_timeout(16)
        if moves == 60:
            page.screenshot(path=path)
    pictures = page.evaluate("window.pictures")
    page.mouse.up()
    if len(pictures) < 2:
        sys.exit("no picture while dragging")
    seconds = (pictures[-1][0] - pictures[0][0]) / 1000
    sizes = sorted({(width, height) for _, width, height in pictures})
    print(f"dragging: {(len(pictures) - 1) / seconds:.1f} pictures a second of", ", ".join(f"{width} x {height}" for width, height in sizes))


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("address")
    parser.add_argument("folder", type=pathlib.Path)
    parser.add_argument("--stop", action="store_true", help="press the buttons that save and stop the training")
    asked = parser.parse_args()
    asked.folder.mkdir(parents=True, exist_ok=True)
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=["--no-sandbox", "--disable-gpu"])
        page = browser.new_page(viewport={"width": 800, "height": 600})
        messages = []
        page.on("console", lambda message: messages.append(f"{message.type}: {message.text}"))
        page.on("pageerror", lambda error: messages.append(f"error: {error}"))
        # The page itself aborts a picture that is no longer wanted.
        page.on("requestfailed", lambda request: "ERR_ABORTED" in request.failure or messages.append(f"{request.url}: {request.failure}"))
        page.add_init_script(COUNT)

        first_picture(page, asked.address)
        page.wait_for_timeout(REST)
        page.screenshot(path=asked.folder / "rest.png")
        print("at rest:", page.inner_text("output"))
        drag(page, asked.folder / "drag.png")
        page.wait_for_timeout(REST)
        print("at rest:", page.inner_text("output"))
        for channel in ["depth", "opacity", "color"]:
            page.select_option("#channel", channel)
            page.wait_for_timeout(REST)
            page.screenshot(path=asked.folder / f"{channel}.png")
        page.select_option("#views", "3")
        page.wait_for_timeout(REST)
        page.screenshot(path=asked.folder / "camera.png")
        # A program that has stopped no longer answers, which the console tells.
        before_stop = list(messages)
        if asked.stop:
            for button in ["#checkpoint", "#stop"]:
                page.click(button)
                page.wait_for_timeout(REST)
                print(f"{button}:", page.inner_text("#message"))
            page.screenshot(path=asked.folder / "stopped.png")
        browser.close()
    print("console:", before_stop or "clean")
    sys.exit(bool(before_stop))


if __name__ == "__main__":
    main()
