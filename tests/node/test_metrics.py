"""Counters, gauges and histograms, read back by Prometheus' own parser; and the page that serves them."""

from __future__ import annotations

import urllib.error
import urllib.request

import pytest
from prometheus_client.parser import text_string_to_metric_families

from cobevglue.node import Metrics, MetricsPage
from cobevglue.node.metrics_server import serve_metrics


def read(text: str) -> dict[tuple[str, tuple[tuple[str, str], ...]], float]:
    return {
        (sample.name, tuple(sorted(sample.labels.items()))): sample.value
        for family in text_string_to_metric_families(text)
        for sample in family.samples
    }


def test_text_is_read_by_prometheus() -> None:
    metrics = Metrics()
    metrics.count("refused_total", reason="late")
    metrics.count("refused_total", 2, reason='odd "name"\\\n')
    metrics.set("alignment_risk", float("nan"), agent="car2")
    metrics.set("time_offset_seconds", -0.125, agent="Straße")
    for seconds in (0.0005, 0.02, 0.021, 5.0):
        metrics.observe("message_seconds", seconds)
    found = read(metrics.text())
    assert found["cobevglue_refused_total", (("reason", "late"),)] == 1
    assert found["cobevglue_refused_total", (("reason", 'odd "name"\\\n'),)] == 2
    assert found["cobevglue_time_offset_seconds", (("agent", "Straße"),)] == -0.125
    assert found["cobevglue_message_seconds_bucket", (("le", "0.02"),)] == 2
    assert found["cobevglue_message_seconds_bucket", (("le", "+Inf"),)] == 4
    assert found["cobevglue_message_seconds_count", ()] == 4
    assert found["cobevglue_message_seconds_sum", ()] == pytest.approx(5.0415)


def test_empty_metrics_are_valid() -> None:
    assert read(Metrics().text())


def test_sums_over_labels() -> None:
    metrics = Metrics()
    metrics.count("alignments_total", agent="a", verdict="accepted")
    metrics.count("alignments_total", 3, agent="b", verdict="accepted")
    metrics.count("alignments_total", agent="b", verdict="refused")
    assert metrics.value("alignments_total", verdict="accepted") == 4
    assert metrics.by("alignments_total", "agent") == {"a": 1, "b": 4}
    metrics.drop_agent("b")
    assert metrics.value("alignments_total") == 1


def test_unknown_metric_name_is_an_error() -> None:
    with pytest.raises(KeyError):
        Metrics().count("refuseds_total")


def test_page_is_served_on_loopback() -> None:
    page = MetricsPage()
    page.text = Metrics().text()
    with serve_metrics(page, 0) as port:
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/metrics", timeout=10) as answer:
            assert answer.read().decode() == page.text
            assert answer.headers["Content-Type"].startswith("text/plain; version=0.0.4")
        with pytest.raises(urllib.error.HTTPError, match="404"):
            urllib.request.urlopen(f"http://127.0.0.1:{port}/other", timeout=10)
        with pytest.raises(OSError, match=f"metrics: port {port}"), serve_metrics(page, port):
            pass
    with serve_metrics(page, port):
        pass  # free again
