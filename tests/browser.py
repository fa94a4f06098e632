"""Chromium without a window and without a network, for pages that we write: fixture `browser`.

Where there is no browser its tests are skipped with the reason, but for `.ci/test`, which sets
CMMSIM_BROWSER=required.
"""

import base64
import json
import os
import shutil
import time
from contextlib import ExitStack
from pathlib import Path

import pytest

NAMES = ("chromium", "chromium-browser", "google-chrome")
FLAGS = (
    "--headless=new", "--no-sandbox", "--disable-gpu-sandbox", "--disable-background-networking", "--disable-sync",
    "--disable-component-update", "--no-first-run", "--hide-scrollbars", "--host-resolver-rules=MAP * ~NOTFOUND",
)  # fmt: skip
SOFTWARE_WEBGL = (
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist",
)
NO_WEBGL = ("--disable-3d-apis",)
# Addresses of a page itself, and of the browser's own empty one.
OWN = ("file:", "data:", "blob:", "about:", "chrome:", "chrome-untrusted:")


class Browser:
    """One running Chromium; `driver` is selenium's."""

    def __init__(self, webgl, profile):
        from selenium import webdriver

        options = webdriver.ChromeOptions()
        options.binary_location = _required(*NAMES)
        for flag in (
            *FLAGS,
            *(SOFTWARE_WEBGL if webgl else NO_WEBGL),
            f"--user-data-dir={profile}",
        ):
            options.add_argument(flag)
        options.set_capability("goog:loggingPrefs", {"browser": "ALL", "performance": "ALL"})
        self.driver = webdriver.Chrome(options, webdriver.ChromeService(_required("chromedriver")))

    def open(self, path, size=(1280, 900), dark=False, media="screen"):
        """Load a file in a window of that size, px, light or dark, as on a screen or in "print";
        seconds it took.
        """
        self.console(), self.requests()  # what pages before have left
        command = self.driver.execute_cdp_cmd
        metrics = {
            "width": size[0],
            "height": size[1],
            "deviceScaleFactor": 1,
            "mobile": size[0] < 600,
        }
        command("Emulation.setDeviceMetricsOverride", metrics)
        scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
        command("Emulation.setEmulatedMedia", {"media": media, "features": [scheme]})
        began = time.perf_counter()
        self.driver.get(Path(path).resolve().as_uri())
        return time.perf_counter() - began

    def run(self, script, *arguments):
        """What a script (a body of a function, with `return`) returns."""
        return self.driver.execute_script(script, *arguments)

    def wait(self, condition, seconds=10.0):
        """Wait until a JavaScript expression is true, and return its value."""
        ends = time.monotonic() + seconds
        while not (value := self.run(f"return {condition}")):
            assert time.monotonic() < ends, (
                f"not within {seconds} s: {condition}; console: {self.console()}"
            )
            time.sleep(0.02)
        return value

    def console(self):
        """Warnings and errors in the console since this was last asked."""
        return [
            entry["message"]
            for entry in self.driver.get_log("browser")
            if entry["level"] in ("SEVERE", "WARNING")
        ]

    def requests(self):
        """Addresses asked for beyond the file itself since this was last asked."""
        messages = [
            json.loads(entry["message"])["message"] for entry in self.driver.get_log("performance")
        ]
        asked = [
            m["params"]["request"]["url"]
            for m in messages
            if m["method"] == "Network.requestWillBeSent"
        ]
        return [url for url in asked if not url.startswith(OWN)]

    def picture(self, path):
        """Save the whole page as PNG, to be looked at."""
        size = self.driver.execute_cdp_cmd("Page.getLayoutMetrics", {})["cssContentSize"]
        clip = {"x": 0, "y": 0, "width": size["width"], "height": size["height"], "scale": 1}
        shot = {"format": "png", "captureBeyondViewport": True, "clip": clip}
        Path(path).write_bytes(
            base64.b64decode(self.driver.execute_cdp_cmd("Page.captureScreenshot", shot)["data"])
        )


def _required(*names):
    """Path of the first of these programs that is installed."""
    found = next(filter(None, map(shutil.which, names)), None)
    if found is None:
        reason = (
            f"none of {', '.join(names)} is installed (Debian's packages: chromium and "
            "chromium-driver)"
        )
        if os.environ.get("CMMSIM_BROWSER") == "required":
            pytest.fail(reason)
        pytest.skip(reason)
    return found


@pytest.fixture(scope="session")
def running_browsers(tmp_path_factory):
    """A function (webgl=True) of a running `Browser`; each kind is started once a process."""
    running = {}
    with ExitStack() as stack:

        def started(webgl=True):
            if webgl not in running:
                running[webgl] = Browser(webgl, tmp_path_factory.mktemp("profile"))
                stack.callback(running[webgl].driver.quit)
            return running[webgl]

        yield started


@pytest.fixture
def browser(running_browsers):
    """A function (webgl=True) of a running `Browser`, which shows nothing after the test: a page
    that plays would be drawn without a graphics card until all tests have ended.
    """
    used = {}

    def started(webgl=True):
        used[webgl] = running_browsers(webgl)
        return used[webgl]

    yield started
    for one in used.values():
        one.driver.get("about:blank")
