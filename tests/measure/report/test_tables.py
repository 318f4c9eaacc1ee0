"""Tables: present columns, bold values, differences, means."""

from bitymi_ns.measure.report.records import Records, link
from bitymi_ns.measure.report.tables import COLUMNS, FITTED, Row, Table, quality_tables, to_markdown
from tests.measure.report.conftest import make, page_of
from tests.view.browser import drive, plain_server


def test_layout_before_and_after_baking():
    rows = [
        make(psnr=27.40, flip=0.12, render_ms=50.0, surfels=12345, atlas_bytes=0),
        make(psnr=27.38, flip=0.12, render_ms=10.0, surfels=12345, bundle_bytes=2_500_000),
    ]
    link(records := Records(rows))
    (table,) = quality_tables(records.evaluations)
    assert table.header == ["Method", "PSNR ↑", "FLIP ↓", "Bundle MB ↓", "Points ↓", "ms ↓", "ΔPSNR"]
    before, trained, after, baked = table.rows
    assert [before.cells, after.cells] == [["Trained scene"], ["Baked bundle"]]
    assert trained.cells == ["bitymi", "27.40", "0.120", "–", "12,345", "50.0", "–"]
    assert baked.cells == ["bitymi", "27.38", "0.120", "2.50", "12,345", "10.0", "−0.020"]
    assert trained.best == {1} and baked.best == {5}  # equal columns have no best


def test_bytes_are_in_sight_in_a_window_of_1280_pixels(tmp_path):
    """With every column, in a browser."""
    every = {column.key: 0.8881 for column in (*COLUMNS, *FITTED)}
    every |= dict(psnr=27.4, fitted_psnr=27.4, surfels=1_234_567, render_ms=123.4, fragments_per_pixel=48.3)
    every |= dict(atlas_bytes=123_456_789, bundle_bytes=23_456_789)
    trained = {key: value for key, value in every.items() if "bytes" not in key}
    rows = [make(method="bitymi-quality", **trained), make(method="bitymi-quality", **every)]
    link(records := Records(rows))
    main, fitted = quality_tables(records.evaluations)
    assert main.header[-1] == "ΔPSNR" and main.header.index("Bundle MB ↓") < main.header.index("Points ↓")
    assert fitted.title == "fox, exposure aside"
    assert [title for title in main.header if "fitted" in title or "mean" in title] == []
    (tmp_path / "index.html").write_text(page_of(quality=[main, fitted]), "utf8")
    wide = "[...document.querySelectorAll('.wide')].map((each) => each.scrollWidth - each.clientWidth)"
    with plain_server(tmp_path, ranges=False) as (address, _):
        found = drive([["goto", address], ["ask", wide]], (1280, 800), drawn=False)
    assert found.results[-1] == [0, 0]


def test_missing_values_are_dashes_and_never_best():
    rows = [make(psnr=20.0, lpips=float("nan")), make(method="other", psnr=21.0, lpips=0.2)]
    (table,) = quality_tables(rows)
    assert table.rows[1].cells[2] == "–" and 2 not in table.rows[1].best
    (table,) = quality_tables([make(psnr=20.0, ssim=0.9)])  # empty columns are omitted
    assert table.header == ["Method", "PSNR ↑", "SSIM ↑"]


def test_means_only_over_what_covers_the_same_scenes():
    rows = [make(scene=s, psnr=p) for s, p in (("a", 20.0), ("b", 22.0))] + [make(scene="a", method="x", psnr=40.0)]
    *scenes, mean = quality_tables(rows)
    assert [t.title for t in scenes] == ["a", "b"]
    assert mean.title == "Mean of 2 scenes" and "a, b" in mean.note
    assert [row.cells for row in mean.rows] == [["Trained scene"], ["bitymi", "21.00"]]


def test_names_cannot_break_the_table():
    table = Table("t", ["Method", "A"], [Row(["<script>a|b</script>", "1"], {1})])
    title = table.rows[0].cells[0]
    page = page_of(title=title, notes=[title], quality=[table, table])
    assert "<script>" not in page and page.count("<th>&lt;script&gt;a|b&lt;/script&gt;</th>") == 2
    assert page.count("<td><b>1</b></td>") == 2 and "<title>&lt;script&gt;a|b&lt;/script&gt;</title>" in page
    assert to_markdown(table).splitlines()[2] == "| <script>a\\|b</script> | **1** |"
