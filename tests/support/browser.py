"""A headless browser that writes down what it is asked for."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from selenium import webdriver
from selenium.webdriver.support.wait import WebDriverWait

_FLAGS = (
    *("--headless", "--no-sandbox", "--disable-gpu", "--enable-unsafe-swiftshader", "--no-first-run"),
    *("--disable-background-networking", "--disable-component-update", "--disable-sync", "--disable-dev-shm-usage"),
)


class Browser:
    def __init__(self, driver: Any) -> None:
        self.driver = driver

    def open(self, path: Path, *, width: int = 1100, height: int = 800) -> None:
        self.command(
            "Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=width < 500
        )
        self.driver.get(path.as_uri())

    def wait(self, expression: str) -> None:
        """Until an expression is true: pages answer events in their own time."""
        WebDriverWait(self.driver, 20, 0.05).until(lambda _: self.tell(expression))

    def command(self, name: str, **arguments: Any) -> Any:
        return self.driver.execute_cdp_cmd(name, arguments)

    def tell(self, expression: str) -> Any:
        return self.driver.execute_script(f"return {expression}")

    def texts(self, selector: str) -> list[str]:
        shown = f"[...document.querySelectorAll({json.dumps(selector)})].filter(e => e.offsetParent)"
        return list(self.tell(f"{shown}.map(e => e.innerText.trim())"))

    def open_report(self, path: Path, *, width: int = 1100) -> None:
        """Load the page of a report and wait for its charts."""
        self.open(path, width=width)
        self.wait("document.documentElement.classList.contains('drawn')")

    def relative_columns(self) -> dict[str, bool]:
        """Whether the relative distances of each table that has some are seen without scrolling it sideways."""
        return dict(
            self.tell(
                "Object.fromEntries([...document.querySelectorAll('th[data-name=relative]')].map(head => { "
                "const [box, area] = [head, head.closest('.scroll')].map(e => e.getBoundingClientRect()); "
                "return [head.closest('table').id, box.left >= area.left && box.right <= area.right]; }))"
            )
        )

    def download_tables(self, folder: Path) -> set[str]:
        """Click the CSV button of every table, and return the names of the files that come into a folder."""
        self.command("Browser.setDownloadBehavior", behavior="allow", downloadPath=str(folder))
        count = self.tell("document.querySelectorAll('button.csv').length")
        self.driver.execute_script("document.querySelectorAll('button.csv').forEach(button => button.click())")
        WebDriverWait(self.driver, 20, 0.05).until(lambda _: len(list(folder.glob("*.csv"))) == count)
        return {path.name for path in folder.glob("*.csv")}

    def complaints(self) -> list[str]:
        """Errors on its console since the last call; of warnings, those are its own about drawing."""
        return [entry["message"] for entry in self.driver.get_log("browser") if entry["level"] == "SEVERE"]

    def requests(self) -> list[str]:
        """The addresses that pages asked for since the last call, but for data within the page itself."""
        events = [json.loads(entry["message"])["message"] for entry in self.driver.get_log("performance")]
        urls = [event["params"]["request"]["url"] for event in events if event["method"] == "Network.requestWillBeSent"]
        # Those of the browser's own pages and extensions have schemes of their own.
        return [url for url in urls if not url.startswith(("data:", "blob:", "chrome", "devtools"))]


@contextmanager
def browser(folder: Path) -> Iterator[Browser]:
    """A browser with an empty profile; tests skip where there is none."""
    program = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    driver_program = shutil.which("chromedriver")
    if program is None or driver_program is None:
        pytest.skip("chromium and chromedriver are not installed: apt-get install chromium chromium-driver")
    options = webdriver.ChromeOptions()
    options.binary_location = program
    for flag in (*_FLAGS, f"--user-data-dir={folder}"):
        options.add_argument(flag)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL", "performance": "ALL"})
    driver = webdriver.Chrome(options=options, service=webdriver.ChromeService(driver_program))
    try:
        yield Browser(driver)
    finally:
        driver.quit()
