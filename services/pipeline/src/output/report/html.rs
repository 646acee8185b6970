//! The parts of a self-contained page: escaped text, tables, embedded images, line charts.

use base64::Engine as _;
use segwild_flow::files::name::shown;
use segwild_scene::Image;
use std::fmt::Write as _;

/// Text of anybody made safe for HTML content and attributes. Characters that change the writing direction are written out.
pub fn escape(text: &str) -> String {
    let mut out = String::with_capacity(text.len());
    for c in shown(text).chars() {
        match c {
            '&' => out.push_str("&amp;"),
            '<' => out.push_str("&lt;"),
            '>' => out.push_str("&gt;"),
            '"' => out.push_str("&quot;"),
            '\'' => out.push_str("&#39;"),
            _ => out.push(c),
        }
    }
    out
}

/// A table; the first row is the head. Cells are text, not HTML.
pub fn table(rows: &[Vec<String>]) -> String {
    let mut out = String::from("<table>");
    for (i, row) in rows.iter().enumerate() {
        let tag = if i == 0 { "th" } else { "td" };
        out.push_str("<tr>");
        for cell in row {
            let _ = write!(out, "<{tag}>{}</{tag}>", escape(cell));
        }
        out.push_str("</tr>");
    }
    out.push_str("</table>");
    out
}

/// An image embedded as JPEG, with its caption. An image with fewer than three channels is shown in grey.
pub fn figure(image: &Image, caption: &str) -> String {
    let mut bytes = Vec::new();
    let encoded = {
        let (w, h) = (image.width as u32, image.height as u32);
        let planes: Vec<&[f32]> =
            (0..3).map(|c| image.plane(if image.channels >= 3 { c } else { 0 })).collect();
        let mut rgb = Vec::with_capacity(image.pixels() * 3);
        for i in 0..image.pixels() {
            for plane in &planes {
                rgb.push((plane[i].clamp(0.0, 1.0) * 255.0).round() as u8);
            }
        }
        image::codecs::jpeg::JpegEncoder::new_with_quality(&mut bytes, 85)
            .encode(&rgb, w, h, image::ExtendedColorType::Rgb8)
            .is_ok()
    };
    let caption = escape(caption);
    if !encoded {
        return format!(
            "<figure><figcaption>{caption} (this image could not be encoded)</figcaption></figure>"
        );
    }
    let data = base64::engine::general_purpose::STANDARD.encode(&bytes);
    format!(
        "<figure><img loading=\"lazy\" alt=\"{caption}\" src=\"data:image/jpeg;base64,{data}\"><figcaption>{caption}</figcaption></figure>"
    )
}

/// A line of a chart.
pub struct ChartSeries {
    /// Shown in the legend.
    pub name: String,
    /// `(x, y)`, x ascending; points that are not finite are left out.
    pub points: Vec<(f64, f64)>,
}

const COLOURS: [&str; 6] = ["#1f6f8b", "#d1495b", "#66a182", "#edae49", "#6a4c93", "#555555"];

/// A line chart as inline SVG, with ticks at round numbers.
pub fn chart(title: &str, x_label: &str, y_label: &str, series: &[ChartSeries]) -> String {
    let (w, h, left, bottom, top, right) = (520.0, 260.0, 58.0, 40.0, 26.0, 12.0);
    let finite = |s: &ChartSeries| -> Vec<(f64, f64)> {
        s.points.iter().copied().filter(|(x, y)| x.is_finite() && y.is_finite()).collect()
    };
    let all: Vec<(f64, f64)> = series.iter().flat_map(finite).collect();
    if all.len() < 2 {
        return String::new();
    }
    let bounds = |pick: fn(&(f64, f64)) -> f64| {
        let lo = all.iter().map(pick).fold(f64::INFINITY, f64::min);
        let hi = all.iter().map(pick).fold(f64::NEG_INFINITY, f64::max);
        if hi > lo { (lo, hi) } else { (lo - 0.5, hi + 0.5) }
    };
    let ((x0, x1), (y0, y1)) = (bounds(|p| p.0), bounds(|p| p.1));
    let px = |x: f64| left + (x - x0) / (x1 - x0) * (w - left - right);
    let py = |y: f64| h - bottom - (y - y0) / (y1 - y0) * (h - bottom - top);
    let mut svg = format!(
        "<svg viewBox=\"0 0 {w} {h}\" role=\"img\"><text x=\"{left}\" y=\"16\" class=\"t\">{}</text>",
        escape(title)
    );
    for x in ticks(x0, x1) {
        let _ = write!(
            svg,
            "<text x=\"{:.1}\" y=\"{}\" class=\"k\" text-anchor=\"middle\">{}</text>",
            px(x),
            h - bottom + 16.0,
            number(x)
        );
    }
    for y in ticks(y0, y1) {
        let _ = write!(
            svg,
            "<line x1=\"{left}\" x2=\"{}\" y1=\"{1:.1}\" y2=\"{1:.1}\" class=\"g\"/><text x=\"{2}\" y=\"{3:.1}\" class=\"k\" text-anchor=\"end\">{4}</text>",
            w - right,
            py(y),
            left - 6.0,
            py(y) + 4.0,
            number(y)
        );
    }
    for (i, s) in series.iter().enumerate() {
        let colour = COLOURS[i % COLOURS.len()];
        let path: Vec<String> =
            finite(s).iter().map(|&(x, y)| format!("{:.1},{:.1}", px(x), py(y))).collect();
        let _ = write!(
            svg,
            "<polyline fill=\"none\" stroke=\"{colour}\" stroke-width=\"1.6\" points=\"{}\"/>",
            path.join(" ")
        );
        let _ = write!(
            svg,
            "<text x=\"{}\" y=\"16\" fill=\"{colour}\" class=\"k\" text-anchor=\"end\">{}</text>",
            w - right - 110.0 * (series.len() - 1 - i) as f64,
            escape(&s.name)
        );
    }
    let _ = write!(
        svg,
        "<text x=\"{}\" y=\"{}\" class=\"k\" text-anchor=\"end\">{}</text><text x=\"4\" y=\"{}\" class=\"k\">{}</text></svg>",
        w - right,
        h - 6.0,
        escape(x_label),
        top - 12.0,
        escape(y_label)
    );
    svg
}

/// A bar of the timeline; times in seconds.
pub struct Bar {
    /// The row it is on.
    pub row: String,
    /// Shown under the pointer.
    pub label: String,
    /// When it starts, in seconds.
    pub start: f64,
    /// When it ends, in seconds.
    pub end: f64,
    /// Whether the time was spent waiting.
    pub waits: bool,
}

/// A bar per span, one row per actor: what ran when, what overlapped, who waited for whom. Bars too short to be
/// seen are joined with the one before, so that long runs stay a page of sensible size.
pub fn timeline(spans: &[Bar]) -> String {
    let end = spans.iter().map(|s| s.end).fold(0.0, f64::max);
    if end <= 0.0 {
        return String::new();
    }
    let mut rows: Vec<&str> = Vec::new();
    for bar in spans {
        if !rows.contains(&bar.row.as_str()) {
            rows.push(&bar.row);
        }
    }
    let (w, left, line) = (1040.0, 90.0, 22.0);
    let h = rows.len() as f64 * line + 26.0;
    let px = |t: f64| left + t / end * (w - left - 10.0);
    let mut svg = format!("<svg viewBox=\"0 0 {w} {h}\" class=\"wide\" role=\"img\">");
    for (k, row) in rows.iter().enumerate() {
        let y = k as f64 * line;
        let _ = write!(svg, "<text x=\"0\" y=\"{}\" class=\"k\">{}</text>", y + 15.0, escape(row));
        let mut covered_to = [f64::MIN; 2];
        for bar in spans.iter().filter(|s| s.row == *row) {
            let to = &mut covered_to[usize::from(bar.waits)];
            if px(bar.end) < *to + 0.4 {
                continue;
            }
            *to = px(bar.end);
            let waits = if bar.waits { "waits for " } else { "" };
            let _ = write!(
                svg,
                "<rect x=\"{:.2}\" y=\"{}\" width=\"{:.2}\" height=\"{}\" fill=\"{}\"><title>{waits}{} {:.1}-{:.1} s</title></rect>",
                px(bar.start),
                y + if bar.waits { 8.0 } else { 3.0 },
                (px(bar.end) - px(bar.start)).max(0.4),
                if bar.waits { 6.0 } else { line - 6.0 },
                if bar.waits { "#bbb" } else { COLOURS[k % COLOURS.len()] },
                escape(&bar.label),
                bar.start,
                bar.end
            );
        }
    }
    for t in ticks(0.0, end) {
        let _ = write!(
            svg,
            "<text x=\"{:.1}\" y=\"{}\" class=\"k\" text-anchor=\"middle\">{} s</text>",
            px(t),
            h - 8.0,
            number(t)
        );
    }
    svg.push_str("</svg>");
    svg
}

/// About five round numbers between two bounds.
fn ticks(lo: f64, hi: f64) -> Vec<f64> {
    let raw = (hi - lo) / 5.0;
    let power = 10f64.powf(raw.log10().floor());
    let step = [1.0, 2.0, 5.0, 10.0].iter().map(|m| m * power).find(|&s| s >= raw).unwrap_or(raw);
    let first = (lo / step).ceil() as i64;
    (first..).map(|k| k as f64 * step).take_while(|&t| t <= hi + 1e-9 * step).collect()
}

/// A number without needless digits.
fn number(x: f64) -> String {
    if x.abs() >= 1e4 {
        format!("{:.0}k", x / 1e3)
    } else {
        let text = format!("{x:.3}");
        text.trim_end_matches('0').trim_end_matches('.').to_owned()
    }
}

/// The whole page.
pub fn page(title: &str, body: &str) -> String {
    let title = escape(title);
    format!(
        "<!doctype html><html lang=\"en\"><head><meta charset=\"utf-8\"><meta name=\"viewport\" content=\"width=device-width\">\
         <title>{title}</title><style>{STYLE}</style></head><body><h1>{title}</h1>{body}</body></html>\n"
    )
}

const STYLE: &str = "body{font:15px/1.5 system-ui,sans-serif;margin:2rem auto;max-width:1080px;padding:0 1rem;color:#222;background:#fff}\
h1{font-size:1.6rem}h2{font-size:1.2rem;margin-top:2.2rem;border-bottom:1px solid #ddd}\
table{border-collapse:collapse;font-size:13px}td,th{padding:.2rem .6rem;border-bottom:1px solid #eee;text-align:left}\
.row{display:grid;grid-template-columns:repeat(auto-fill,minmax(200px,1fr));gap:.6rem;margin:.6rem 0}\
figure{margin:0}img{width:100%;border-radius:3px}figcaption{font-size:12px;color:#666}\
svg{width:520px;max-width:100%}svg.wide{width:100%}.k{font-size:11px;fill:#555}.t{font-size:13px;font-weight:600}.g{stroke:#eee}\
pre{background:#f6f6f6;padding:.8rem;overflow:auto;font-size:12px}summary{cursor:pointer}";

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn text_cannot_break_out() {
        assert!(!table(&[vec!["<script>\"&".into()]]).contains("<script>"));
    }

    #[test]
    fn ticks_are_round_and_inside() {
        assert_eq!(ticks(0.0, 10.0), vec![0.0, 2.0, 4.0, 6.0, 8.0, 10.0]);
        assert!(ticks(0.013, 0.097).iter().all(|&t| (0.013..=0.098).contains(&t)));
    }

    #[test]
    fn a_chart_leaves_out_what_is_not_a_number() {
        let series =
            [ChartSeries { name: "loss".into(), points: vec![(0.0, 1.0), (1.0, f64::NAN), (2.0, 0.5)] }];
        let svg = chart("t", "step", "", &series);
        assert!(svg.contains("polyline") && !svg.contains("NaN"));
    }
}
