"""The live page in a real browser, over a real server that replays a recorded robot. Screenshots lie in target/page."""

import json
import re
import statistics
import threading
import time
from pathlib import Path

import pytest
from playwright.sync_api import expect

import gatsbi_client as gc

ROOT = Path(__file__).resolve().parents[2]
PHONE = {"viewport": {"width": 390, "height": 844}, "device_scale_factor": 2, "has_touch": True, "is_mobile": True}


@pytest.fixture(scope="module")
def arm(server):
    """A session that has observed the start of an episode."""
    session = json.loads(server.gatsbi("session", "new", "--label", "left arm"))["id"]
    server.observe(session, 0, 8)
    return session


def picture(page):
    return page.locator("canvas.scene").evaluate("canvas => canvas.toDataURL()")


def newest(server, session):
    return json.loads(server.gatsbi("session", "show", session))["next_step"] - 1


def at_step(page, step):
    """Waits until a step is drawn."""
    expect(page.get_by_text(f"step {step}", exact=True)).to_be_visible()
    expect(page.locator(".over")).to_be_hidden()


def fits(page):
    wide = page.evaluate("document.documentElement.scrollWidth - document.documentElement.clientWidth")
    assert wide <= 0, f"the page is {wide} pixels too wide"


def test_an_empty_server_says_how_to_begin(open_page, shots):
    page = open_page()
    expect(page.get_by_role("heading", name="No session is open")).to_be_visible()
    expect(page.get_by_text("gatsbi observe --session")).to_be_visible()
    expect(page.locator("#connection")).to_have_text("Live")
    page.screenshot(path=shots / "empty.png")


def test_sessions_are_listed_with_what_they_see(open_page, server, arm, shots):
    page = open_page()
    card = page.get_by_role("link", name=re.compile("left arm"))
    step = newest(server, arm)
    expect(card).to_contain_text(f"step {step}")
    expect(card).to_contain_text("push1-tiny")
    thumbnail = card.locator("img")
    expect(thumbnail).to_be_visible()
    assert thumbnail.evaluate("img => img.naturalWidth") == 64
    before = thumbnail.get_attribute("src")
    server.observe(arm, step + 1, step + 2)
    expect(card).to_contain_text(f"step {step + 1}")
    expect(thumbnail).not_to_have_attribute("src", before)
    page.screenshot(path=shots / "sessions.png")
    card.click()
    expect(page.get_by_role("heading", name="left arm")).to_be_visible()


def test_a_session_shows_its_belief_and_follows_it(open_page, server, arm, shots):
    step = newest(server, arm)
    page = open_page(f"#/sessions/{arm}")
    at_step(page, step)
    rows = page.locator("table.objects tbody tr")
    assert rows.count() >= 2
    colours = rows.locator("visible=true").evaluate_all(
        "rows => rows.filter(row => !row.classList.contains('faint')).map(row => row.querySelector('.mark').style.background)")
    assert len(set(colours)) == len(colours) >= 1 and "" not in colours

    def toggles(name):
        """An overlay changes the picture, and changes it back."""
        before = picture(page)
        page.get_by_role("checkbox", name=name).click()
        changed = picture(page)
        assert changed != before, name
        page.get_by_role("checkbox", name=name).click()
        assert picture(page) == before, name

    for name in ["Agent", "Objects", "Background", "Boxes and ids", "Keypoints"]:
        toggles(name)
    before = picture(page)
    page.get_by_role("radio", name="Belief").click()
    assert picture(page) != before
    page.get_by_role("radio", name="Camera").click()
    server.observe(arm, step + 1, step + 6)
    at_step(page, step + 5)
    assert picture(page) != before
    toggles("Trails")
    expect(page.get_by_role("img", name=re.compile("Surprise: now .* nats"))).to_be_visible()
    expect(page.get_by_role("img", name=re.compile(r"Time of a step: now [\d.,]+ m?s, highest of the last \d+ [\d.,]+ m?s"))).to_be_visible()
    page.get_by_role("button", name="Repeat what was done").click()
    expect(page.get_by_text(re.compile(r"As the last [56] steps"))).to_be_visible()
    with page.expect_download() as saved:
        page.get_by_role("button", name="overlay.png").click()
    assert saved.value.suggested_filename == "overlay.png"
    page.screenshot(path=shots / "session.png", full_page=True)


def test_objects_have_the_colours_of_the_pictures_elsewhere(open_page):
    page = open_page()
    agent, palette = page.evaluate("""import("/page/palette.js").then(({ AGENT, coloursOf }) =>
        [AGENT, [...coloursOf([0, 1, 2, 3, 4, 5, 6, 7]).values()]])""")
    text = (ROOT / "pictures/src/palette.rs").read_text()
    text = text[: text.index("The colours of the objects in one picture")]
    colours = re.findall(r"Rgb\(\[(\d+), (\d+), (\d+)\]\)", text)
    assert ["#%02x%02x%02x" % tuple(map(int, colour)) for colour in colours] == [agent, *palette]
    places = lambda ids: page.evaluate("""ids => import("/page/palette.js").then(({ coloursOf }) =>
        ids.map((id) => coloursOf(ids).get(id)))""", ids)
    assert places([11, 3, 19]) == [palette[at] for at in (4, 3, 5)]
    assert places([7, 15]) == [palette[at] for at in (7, 0)]
    assert places([8 * i for i in range(10)]) == palette + palette[:2]


def test_futures_are_imagined_and_compared_with_what_happened(open_page, server, arm, shots):
    step = newest(server, arm)
    page = open_page(f"#/sessions/{arm}")
    at_step(page, step)
    page.get_by_text("Hold an action").click()
    slider = page.get_by_role("slider", name=re.compile("panda_joint1")).last
    slider.focus()
    for _ in range(20):
        slider.press("ArrowRight")
    page.get_by_role("slider", name=re.compile("Steps ahead")).fill("6")
    page.locator("canvas.scene").click(position={"x": 300, "y": 330})
    page.get_by_label("Who").select_option("agent")
    page.get_by_role("button", name="Find a plan").click()
    expect(page.get_by_text("is among the candidates now")).to_be_visible(timeout=60000)
    page.get_by_role("button", name="Imagine", exact=True).click()
    expect(page.get_by_text(f"5 candidates over 6 steps from step {step}.")).to_be_visible(timeout=60000)
    tiles = page.locator(".rollout")
    assert tiles.count() == 6
    costs = [float(text.split()[1]) for text in page.locator(".rollout .badge:visible").all_inner_texts()]
    best = page.locator(".rollout .badge.good").inner_text()
    assert len(costs) == 5 and f"{min(costs):.3f}" in best
    # What the search promised of its plan is what the rollout measures.
    promised, measured = re.findall(r"cost (\d+\.\d+)", page.locator(".rollout", has_text="Plan of cost").inner_text())
    assert abs(float(promised) - float(measured)) < 0.01

    drawn = lambda tile: tiles.nth(tile).locator("canvas").evaluate("canvas => canvas.toDataURL()")
    first = drawn(1)
    page.get_by_role("slider", name="Step ahead", exact=True).fill("6")
    assert drawn(1) != first
    nothing = drawn(0)
    server.observe(arm, step + 1, step + 7)
    expect(page.get_by_text("All 6 imagined steps have happened.")).to_be_visible()
    assert drawn(0) != nothing
    page.get_by_role("button", name="Imagine what was done").click()
    expect(page.get_by_text("are imagined beside the others")).to_be_visible()
    assert tiles.count() == 7
    differs = {}
    for text in page.locator(".rollout:not(.real)").all_inner_texts():
        differs[text.split("\n")[0]] = float(re.search(r"differs by ([\d.]+)", text)[1])
    print("difference from what happened:", differs)
    done = next(value for name, value in differs.items() if name.startswith("As it was done"))
    others = [value for name, value in differs.items() if not name.startswith("As it was done")]
    assert done < statistics.mean(others), differs
    page.evaluate("scrollTo(0, 0)")
    page.screenshot(path=shots / "imagine.png", full_page=True)
    # What the page kept for itself is not left behind.
    page.get_by_role("link", name="Engine").click()
    expect(page.get_by_role("heading", name="Engine")).to_be_visible()
    for _ in range(50):
        kept = [s for s in json.loads(server.gatsbi("session", "list"))["sessions"] if s["label"].startswith("imagined from")]
        if not kept:
            break
        time.sleep(0.1)
    assert not kept, kept


def test_models_have_cards_and_the_engine_tells_its_load(open_page, server, arm, shots):
    page = open_page("#/models")
    expect(page.get_by_role("heading", name="push1-tiny", level=2)).to_be_visible()
    expect(page.get_by_role("rowheader", name="panda_joint7")).to_be_visible()
    expect(page.get_by_role("heading", name="Known weaknesses")).to_be_visible()
    page.screenshot(path=shots / "models.png", full_page=True)
    page.get_by_role("link", name="Engine").click()
    cell = page.locator("tbody tr", has_text="rows").first.locator("td").first
    expect(cell).not_to_have_text("–")
    rows = int(cell.inner_text().replace(",", ""))
    step = newest(server, arm)
    server.observe(arm, step + 1, step + 5)
    expect(cell).to_have_text(f"{rows + 4:,}")
    expect(page.get_by_text(re.compile(r"Ticks: [\d,]+\. Requests refused: \d+\. What waits now is predicted to take [\d.,]+ \S+\."))).to_be_visible()
    page.wait_for_timeout(1500)
    page.screenshot(path=shots / "engine.png", full_page=True)


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_it_fits_a_phone_in_either_scheme(open_page, server, arm, shots, scheme):
    page = open_page(f"#/sessions/{arm}", color_scheme=scheme, **PHONE)
    at_step(page, newest(server, arm))
    for view in ["session", "sessions", "models", "engine"]:
        if view != "session":
            page.get_by_role("navigation", name="Views").get_by_role("link", name=view, exact=False).first.click()
            expect(page.get_by_role("heading", level=1)).to_have_text(view.capitalize())
            page.wait_for_timeout(1200)
        fits(page)
        page.screenshot(path=shots / f"phone-{scheme}-{view}.png", full_page=True)


def test_it_is_dark_where_the_dark_is_preferred(open_page, server, arm, shots):
    page = open_page(f"#/sessions/{arm}", color_scheme="dark")
    at_step(page, newest(server, arm))
    shade = page.evaluate("getComputedStyle(document.body).backgroundColor")
    assert all(int(part) < 40 for part in re.findall(r"\d+", shade)[:3]), shade
    page.screenshot(path=shots / "session-dark.png", full_page=True)


def test_a_keyboard_and_a_screen_reader_get_everywhere(open_page, server, arm):
    page = open_page(f"#/sessions/{arm}")
    at_step(page, newest(server, arm))
    page.keyboard.press("Tab")
    expect(page.get_by_role("link", name="Skip to content")).to_be_focused()
    page.keyboard.press("Enter")
    expect(page.get_by_role("main")).to_be_focused()
    chip = page.get_by_role("checkbox", name="Background")
    chip.focus()
    before = picture(page)
    page.keyboard.press("Space")
    assert picture(page) != before
    nameless = page.evaluate("""() => [...document.querySelectorAll("button, input, select, a, canvas, meter")].filter((e) => e.checkVisibility()
        && !(e.getAttribute("aria-label") || e.textContent.trim() || [...(e.labels ?? [])].some((l) => l.textContent.trim()))).map((e) => e.outerHTML)""")
    assert not nameless, nameless
    for landmark in ["banner", "navigation", "main"]:
        assert page.get_by_role(landmark).count() == 1, landmark
    # Nothing moves by itself where nothing is to move.
    assert page.get_by_role("button", name="Pause").count() == 0


def test_a_key_is_asked_for_kept_and_sent(open_page, server):
    page = open_page(expected=["401"])
    sent = []
    page.on("request", lambda request: "/v1/" in request.url and sent.append(request.headers.get("authorization")))
    refuse = lambda route: route.fulfill(status=401, content_type="application/problem+json",
                                         body=json.dumps({"status": 401, "title": "Unauthorized", "detail": "a key is needed"}))
    page.route("**/v1/models", refuse)
    page.get_by_role("link", name="Models").click()
    dialog = page.get_by_role("dialog")
    expect(dialog).to_contain_text("a key is needed")
    page.unroute("**/v1/models")
    page.get_by_label("Key", exact=True).fill("secret")
    page.keyboard.press("Enter")
    expect(page.get_by_role("heading", name="push1-tiny", level=2)).to_be_visible()
    assert sent[-1] == "Bearer secret"
    page.get_by_role("link", name="Sessions").click()
    expect(page.locator("#connection")).to_have_text("Live")
    expect(page.locator(".tiles dd").first).not_to_have_text("–")
    assert sent[-1] == "Bearer secret", "feeds send it too"
    page.get_by_role("button", name=re.compile("Key")).click()
    page.get_by_role("button", name="Forget the key").click()
    # Not `wait_for_function`: what it evaluates again later, the page's Content-Security-Policy refuses.
    until = time.monotonic() + 20
    while page.evaluate("sessionStorage.length") > 0:
        assert time.monotonic() < until, "the key is still kept"
        page.wait_for_timeout(20)


def test_the_api_page_is_here_too(open_page, shots):
    # A style in its library's own page is refused by the policy, and not missed.
    page = open_page("docs/", expected=["Applying inline style violates"])
    operation = page.locator("#operations-ModelService-ListModels")
    operation.get_by_role("button").first.click()
    operation.get_by_role("button", name="Try it out").click()
    operation.get_by_role("button", name="Execute").click()
    expect(operation.locator(".live-responses-table")).to_contain_text("push1-tiny")
    page.screenshot(path=shots / "docs.png")


def test_a_session_that_is_closed_says_so(open_page, server):
    session = json.loads(server.gatsbi("session", "new"))["id"]
    page = open_page(f"#/sessions/{session}", expected=["404"])
    expect(page.get_by_text("Waiting for the first observation")).to_be_visible()
    server.gatsbi("session", "delete", session)
    expect(page.get_by_role("heading", name="This session is closed")).to_be_visible()
    page.reload()
    expect(page.get_by_role("heading", name="This session is closed")).to_be_visible()


def test_it_keeps_up_with_ten_steps_a_second(open_page, server, episode):
    frames, actions = episode
    with gc.Client(server.grpc) as client:
        session = client.create_session(label="10 Hz")
        page = open_page(f"#/sessions/{session.id}")
        expect(page.get_by_text("Waiting for the first observation")).to_be_visible()
        answered = {}

        def robot():
            began = time.monotonic()
            for step in range(len(frames)):
                time.sleep(max(0, began + step * 0.1 - time.monotonic()))
                session.observe(frames[step], actions[step - 1] if step else None)
                answered[step] = time.time() * 1000

        thread = threading.Thread(target=robot)
        began = time.monotonic()
        thread.start()
        while thread.is_alive():
            page.wait_for_timeout(50)
        took = time.monotonic() - began
        at_step(page, len(frames) - 1)
        marks = page.evaluate("""performance.getEntriesByName("belief drawn").map((mark) =>
            [mark.detail.step, performance.timeOrigin + mark.startTime, mark.detail.at])""")
    drawn = {int(step): (at, there) for step, at, there in marks}
    waits = sorted(at - answered[step] for step, (at, _) in drawn.items())
    whole = sorted(at - there for at, there in drawn.values())
    told = lambda times: f"median {statistics.median(times):.0f} ms, 95th percentile {times[int(0.95 * (len(times) - 1))]:.0f} ms"
    print(f"{len(frames)} steps in {took:.1f} s, {len(drawn)} drawn; from the observation's answer to the picture: {told(waits)}; "
          f"from the belief in the server: {told(whole)}")
    assert len(drawn) >= 0.8 * len(frames)
    # Nothing piles up, even where a step itself takes a second because others use the processor.
    assert waits[int(0.95 * (len(waits) - 1))] < 1000


def test_a_lost_connection_is_said_and_mended(open_page, server, shots):
    page = open_page(expected=["ERR_CONNECTION_REFUSED", "ERR_INCOMPLETE_CHUNKED_ENCODING", "ERR_CONNECTION_RESET", "ERR_NETWORK"])
    expect(page.locator("#connection")).to_have_text("Live")
    server.stop()
    expect(page.get_by_text("Connection lost. What you see is the last that came")).to_be_visible()
    page.screenshot(path=shots / "lost.png")
    server.start()
    expect(page.locator("#connection")).to_have_text("Live", timeout=30000)
    expect(page.locator("#lost")).to_be_hidden()
