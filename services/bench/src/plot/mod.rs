//! Figures: panels of points and lines with error bars, as SVG, as PNG, and with a note under every point for a page.

mod axis;

use axis::Axis;
pub use axis::short;
use plotters::backend::BitMapBackend;
use plotters::prelude::*;
use plotters::style::text_anchor::{HPos, Pos, VPos};
use plotters::style::{FontStyle, register_font};
use std::sync::Once;

/// Okabe and Ito's colours, which people with any colour vision distinguish, and three more.
const COLOURS: [RGBColor; 10] = [
    RGBColor(0, 114, 178),
    RGBColor(213, 94, 0),
    RGBColor(0, 158, 115),
    RGBColor(204, 121, 167),
    RGBColor(230, 159, 0),
    RGBColor(86, 180, 233),
    RGBColor(117, 76, 41),
    RGBColor(128, 128, 0),
    RGBColor(106, 61, 154),
    RGBColor(90, 90, 90),
];
const INK: RGBColor = RGBColor(38, 38, 38);
const PALE: RGBColor = RGBColor(225, 225, 225);
/// The name under which the font of the PNGs is registered; browsers take theirs.
const FONT: &str = "sans-serif";

/// One measured value on a panel.
#[derive(Clone, Debug, Default)]
pub struct Mark {
    /// Position.
    pub x: f64,
    /// Position.
    pub y: f64,
    /// Half the length of the horizontal and the vertical error bar; 0 draws none.
    pub error: [f64; 2],
    /// Words beside it; may be empty.
    pub label: String,
    /// Words that a page shows when it is pointed at.
    pub note: String,
    /// Drawn larger, as the one that others are compared with.
    pub chosen: bool,
}

/// What belongs together on a panel.
#[derive(Clone, Debug, Default)]
pub struct PlotSeries {
    /// Name in the legend: the same in all panels of a figure.
    pub name: String,
    /// The marks.
    pub marks: Vec<Mark>,
    /// Whether a line goes through them.
    pub line: bool,
}

/// Two axes and what is measured on them.
#[derive(Clone, Debug, Default)]
pub struct Panel {
    /// Heading.
    pub title: String,
    /// What is to the right.
    pub x: String,
    /// What is up.
    pub y: String,
    /// Whether x grows by factors.
    pub log_x: bool,
    /// Whether y grows by factors.
    pub log_y: bool,
    /// Positions on the x axis that have names instead of numbers, from 0 on.
    pub names: Vec<String>,
    /// The measurements.
    pub series: Vec<PlotSeries>,
    /// Whether the y axis goes down to 0.
    pub y_from_zero: bool,
    /// Corners of a front: drawn as steps, better up and to the left.
    pub front: Vec<(f64, f64)>,
}

/// Panels in rows, with one legend.
#[derive(Clone, Debug, Default)]
pub struct Figure {
    /// Heading.
    pub title: String,
    /// Panels, row by row.
    pub panels: Vec<Panel>,
    /// Panels in a row.
    pub columns: usize,
    /// Width and height of a panel in pixels.
    pub panel: [u32; 2],
}

/// Why a figure cannot be drawn.
#[derive(Debug, thiserror::Error)]
#[error("a figure cannot be drawn: {0}")]
pub struct PlotError(String);

fn fail(error: impl std::fmt::Display) -> PlotError {
    PlotError(error.to_string())
}

/// Width of the column that holds the legend, and height of the figure's heading.
const LEGEND: u32 = 170;
const HEADING: u32 = 40;

impl Figure {
    fn size(&self) -> (u32, u32) {
        let columns = self.columns.clamp(1, self.panels.len().max(1)) as u32;
        let rows = (self.panels.len() as u32).div_ceil(columns);
        let legend = if self.has_legend() { LEGEND } else { 0 };
        (columns * self.panel[0] + legend, rows * self.panel[1] + HEADING)
    }

    fn has_legend(&self) -> bool {
        self.legend().len() > 1 || self.panels.iter().any(|p| !p.front.is_empty())
    }

    /// Names of all series, in the order they first come.
    fn legend(&self) -> Vec<&str> {
        let mut names: Vec<&str> = Vec::new();
        for series in self.panels.iter().flat_map(|p| &p.series) {
            if !names.contains(&series.name.as_str()) {
                names.push(&series.name);
            }
        }
        names
    }

    /// The figure as SVG. Marks with a note say it when they are pointed at.
    pub fn svg(&self) -> Result<String, PlotError> {
        let mut text = String::new();
        let area = SVGBackend::with_string(&mut text, self.size()).into_drawing_area();
        let notes = self.draw(&area, 1.0)?;
        drop(area);
        let spots: String = notes
            .iter()
            .map(|(x, y, note)| {
                let note = escaped(note);
                format!("<circle cx=\"{x}\" cy=\"{y}\" r=\"9\" fill=\"#fff\" fill-opacity=\"0\"><title>{note}</title></circle>\n")
            })
            .collect();
        let end = text.rfind("</svg>").ok_or_else(|| fail("the SVG text has no closing tag"))?;
        text.insert_str(end, &spots);
        Ok(text)
    }

    /// The figure as PNG, twice as fine as the SVG's pixels.
    pub fn png(&self) -> Result<Vec<u8>, PlotError> {
        const FINER: u32 = 2;
        let (w, h) = self.size();
        let (w, h) = (w * FINER, h * FINER);
        let mut pixels = vec![0u8; 3 * w as usize * h as usize];
        {
            let area = BitMapBackend::with_buffer(&mut pixels, (w, h)).into_drawing_area();
            self.draw(&area, f64::from(FINER))?;
        }
        let image = image::RgbImage::from_raw(w, h, pixels)
            .ok_or_else(|| fail("the pixels do not fill the image"))?;
        let mut file = std::io::Cursor::new(Vec::new());
        image.write_to(&mut file, image::ImageFormat::Png).map_err(fail)?;
        Ok(file.into_inner())
    }

    /// Draws it; where its marks are and what they have to say.
    fn draw<B: DrawingBackend>(
        &self,
        area: &DrawingArea<B, plotters::coord::Shift>,
        scale: f64,
    ) -> Result<Vec<(i32, i32, String)>, PlotError> {
        load_fonts();
        let px = |v: u32| (f64::from(v) * scale) as i32;
        area.fill(&WHITE).map_err(fail)?;
        let title = style(17.0 * scale, true);
        area.draw(&Text::new(self.title.clone(), (px(14), px(12)), title)).map_err(fail)?;
        let (_, body) = area.split_vertically(px(HEADING));
        let names = self.legend();
        let columns = self.columns.clamp(1, self.panels.len().max(1));
        let panels = if self.has_legend() {
            let (panels, legend) = body.split_horizontally(px(columns as u32 * self.panel[0]));
            draw_legend(&legend, &names, scale, self.panels.iter().any(|p| !p.front.is_empty()))?;
            panels
        } else {
            body
        };
        let rows = self.panels.len().div_ceil(columns);
        let mut notes = Vec::new();
        for (panel, part) in self.panels.iter().zip(panels.split_evenly((rows, columns))) {
            notes.extend(panel.draw(&part, &names, scale)?);
        }
        area.present().map_err(fail)?;
        Ok(notes)
    }
}

impl Panel {
    fn draw<B: DrawingBackend>(
        &self,
        area: &DrawingArea<B, plotters::coord::Shift>,
        names: &[&str],
        scale: f64,
    ) -> Result<Vec<(i32, i32, String)>, PlotError> {
        let px = |v: f64| (v * scale).round() as i32;
        let ends = |k: usize| {
            let marks = self.series.iter().flat_map(|s| &s.marks);
            marks.flat_map(move |m| {
                let v = if k == 0 { m.x } else { m.y };
                [v - m.error[k], v + m.error[k]]
            })
        };
        let x = Axis::around(&ends(0).collect::<Vec<_>>(), self.log_x, &self.names);
        let zero = self.y_from_zero.then_some(0.0);
        let y = Axis::around(&ends(1).chain(zero).collect::<Vec<_>>(), self.log_y, &[]);
        let (left, right, low) = (x.from, x.to, y.from);
        let names_of_x = self.names.clone();
        let mut chart = ChartBuilder::on(area)
            .caption(&self.title, style(14.0 * scale, true))
            .margin(px(10.0))
            .x_label_area_size(px(40.0))
            .y_label_area_size(px(62.0))
            .build_cartesian_2d(x, y)
            .map_err(fail)?;
        let label = move |v: &f64| match names_of_x.get(v.round().max(0.0) as usize) {
            Some(name) => name.clone(),
            None => short(*v),
        };
        chart
            .configure_mesh()
            .x_labels(8)
            .y_labels(8)
            .max_light_lines(1)
            .light_line_style(WHITE.mix(0.0))
            .bold_line_style(PALE.stroke_width(px(1.0) as u32))
            .axis_style(INK.mix(0.6).stroke_width(px(1.0) as u32))
            .label_style(style(12.0 * scale, false))
            .axis_desc_style(style(13.0 * scale, false))
            .x_desc(&self.x)
            .y_desc(&self.y)
            .x_label_formatter(&label)
            .y_label_formatter(&|v| short(*v))
            .draw()
            .map_err(fail)?;
        if let (Some(first), Some(last)) = (self.front.first(), self.front.last()) {
            let mut steps = vec![(first.0, low), *first];
            for two in self.front.windows(2) {
                steps.extend([(two[1].0, two[0].1), two[1]]);
            }
            steps.push((right, last.1));
            chart
                .draw_series([PathElement::new(steps, INK.mix(0.35).stroke_width(px(2.0) as u32))])
                .map_err(fail)?;
        }
        let mut notes = Vec::new();
        let mut lettered: Vec<(i32, i32)> = Vec::new();
        for series in &self.series {
            let which = names.iter().position(|n| *n == series.name).unwrap_or(0);
            let colour = COLOURS[which % COLOURS.len()];
            if series.line {
                let path: Vec<(f64, f64)> = series.marks.iter().map(|m| (m.x, m.y)).collect();
                let line = PathElement::new(path, colour.mix(0.75).stroke_width(px(2.0) as u32));
                chart.draw_series([line]).map_err(fail)?;
            }
            for mark in &series.marks {
                let [ex, ey] = mark.error;
                let bar = colour.mix(0.55).stroke_width(px(1.4) as u32);
                if ey > 0.0 {
                    let ends = vec![(mark.x, mark.y - ey), (mark.x, mark.y + ey)];
                    chart.draw_series([PathElement::new(ends, bar)]).map_err(fail)?;
                }
                if ex > 0.0 {
                    let ends = vec![((mark.x - ex).max(left), mark.y), (mark.x + ex, mark.y)];
                    chart.draw_series([PathElement::new(ends, bar)]).map_err(fail)?;
                }
                let at = (mark.x, mark.y);
                let (r, shape) = (px(if mark.chosen { 8.0 } else { 5.0 }), which);
                let spot = EmptyElement::at(at);
                if mark.chosen {
                    let star = star(f64::from(r) * 1.35);
                    let rim = Circle::new((0, 0), px(11.0), INK.stroke_width(px(1.6) as u32));
                    let star = Polygon::new(star, INK.filled());
                    chart.draw_series([spot + star + rim]).map_err(fail)?;
                } else {
                    let body = Polygon::new(outline(shape, f64::from(r)), colour.filled());
                    chart.draw_series([spot + body]).map_err(fail)?;
                }
                if !mark.label.is_empty() {
                    // Not over the words of a neighbour.
                    let (x, y) = chart.backend_coord(&at);
                    let mut up = px(if mark.chosen { -16.0 } else { -11.0 });
                    let wide = px(6.4 * mark.label.chars().count() as f64);
                    let meets = |up: i32| {
                        lettered.iter().any(|(u, v)| (u - x).abs() < wide && (v - y - up).abs() < px(12.0))
                    };
                    while meets(up) && up > px(-60.0) {
                        up -= px(12.0);
                    }
                    lettered.push((x, y + up));
                    let words = Text::new(
                        mark.label.clone(),
                        (0, up),
                        style(11.0 * scale, mark.chosen).pos(Pos::new(HPos::Center, VPos::Bottom)),
                    );
                    chart.draw_series([EmptyElement::at(at) + words]).map_err(fail)?;
                }
                if !mark.note.is_empty() {
                    let (x, y) = chart.backend_coord(&at);
                    notes.push((x, y, mark.note.clone()));
                }
            }
        }
        Ok(notes)
    }
}

fn draw_legend<B: DrawingBackend>(
    area: &DrawingArea<B, plotters::coord::Shift>,
    names: &[&str],
    scale: f64,
    front: bool,
) -> Result<(), PlotError> {
    let px = |v: f64| (v * scale).round() as i32;
    let mut y = 34.0;
    let words = |text: &str, y: f64| {
        let anchor = Pos::new(HPos::Left, VPos::Center);
        Text::new(text.to_owned(), (px(30.0), px(y)), style(12.0 * scale, false).pos(anchor))
    };
    for (which, name) in names.iter().enumerate() {
        let colour = COLOURS[which % COLOURS.len()];
        let shape = outline(which, f64::from(px(5.0)));
        let shape: Vec<(i32, i32)> = shape.iter().map(|(a, b)| (a + px(15.0), b + px(y))).collect();
        area.draw(&Polygon::new(shape, colour.filled())).map_err(fail)?;
        area.draw(&words(name, y)).map_err(fail)?;
        y += 22.0;
    }
    if front {
        let star: Vec<(i32, i32)> =
            star(f64::from(px(8.0))).iter().map(|(a, b)| (a + px(15.0), b + px(y))).collect();
        area.draw(&Polygon::new(star, INK.filled())).map_err(fail)?;
        area.draw(&words("our default", y)).map_err(fail)?;
        y += 22.0;
        let line = vec![(px(6.0), px(y)), (px(24.0), px(y))];
        area.draw(&PathElement::new(line, INK.mix(0.35).stroke_width(px(2.0) as u32))).map_err(fail)?;
        area.draw(&words("Pareto front", y)).map_err(fail)?;
    }
    Ok(())
}

/// A shape of its own for each series, so that colour is not all that tells them apart.
fn outline(which: usize, r: f64) -> Vec<(i32, i32)> {
    let regular = |corners: usize, turn: f64, r: f64| -> Vec<(i32, i32)> {
        (0..corners)
            .map(|k| {
                let angle = std::f64::consts::TAU * (k as f64 / corners as f64) + turn;
                ((r * angle.sin()).round() as i32, (-r * angle.cos()).round() as i32)
            })
            .collect()
    };
    let half = std::f64::consts::FRAC_PI_4;
    match which % 5 {
        0 => regular(24, 0.0, r),
        1 => regular(4, half, 1.25 * r),
        2 => regular(3, 0.0, 1.35 * r),
        3 => regular(4, 0.0, 1.3 * r),
        _ => regular(3, std::f64::consts::PI, 1.35 * r),
    }
}

/// A star with five points.
fn star(r: f64) -> Vec<(i32, i32)> {
    (0..10)
        .map(|k| {
            let r = if k % 2 == 0 { r } else { 0.45 * r };
            let angle = std::f64::consts::TAU * f64::from(k) / 10.0;
            ((r * angle.sin()).round() as i32, (-r * angle.cos()).round() as i32)
        })
        .collect()
}

fn style(size: f64, bold: bool) -> TextStyle<'static> {
    let weight = if bold { FontStyle::Bold } else { FontStyle::Normal };
    TextStyle::from((FONT, size, weight).into_font()).color(&INK)
}

/// The fonts by which PNGs are lettered and all texts are measured: those of this crate, so that a figure is the same
/// on every machine.
fn load_fonts() {
    static ONCE: Once = Once::new();
    ONCE.call_once(|| {
        let _ = register_font(FONT, FontStyle::Normal, include_bytes!("../../assets/sans.ttf"));
        let _ = register_font(FONT, FontStyle::Bold, include_bytes!("../../assets/sans-bold.ttf"));
    });
}

/// Text of this program inside HTML or SVG, and inside attributes in double quotes. Apostrophes stay as they are: for the text of
/// others there is the report's `escape`, which would change the committed figures.
pub fn escaped(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;").replace('"', "&quot;")
}

/// The corners of the front of points `(cost, worth)`: those that no other point beats in both, cheapest first.
pub fn front(points: &[(f64, f64)]) -> Vec<(f64, f64)> {
    let mut sorted: Vec<(f64, f64)> =
        points.iter().copied().filter(|p| p.0.is_finite() && p.1.is_finite()).collect();
    sorted.sort_by(|a, b| a.0.total_cmp(&b.0).then(b.1.total_cmp(&a.1)));
    let mut best = f64::NEG_INFINITY;
    sorted.retain(|p| {
        let better = p.1 > best;
        best = best.max(p.1);
        better
    });
    sorted
}

#[cfg(test)]
mod tests {
    use super::*;

    fn figure() -> Figure {
        let mark = |x: f64, y: f64, chosen: bool| Mark {
            x,
            y,
            error: [0.1, 0.02],
            label: "1000".into(),
            note: format!("steps {x} <fast>"),
            chosen,
        };
        let marks = vec![mark(1.0, 0.5, false), mark(2.0, 0.7, true), mark(5.0, 0.72, false)];
        let series = vec![
            PlotSeries { name: "steps".into(), marks: marks.clone(), line: true },
            PlotSeries { name: "splats".into(), marks, line: false },
        ];
        let front = vec![(1.0, 0.5), (2.0, 0.7), (5.0, 0.72)];
        let panel = Panel {
            title: "a".into(),
            x: "time".into(),
            y: "IoU".into(),
            log_x: true,
            series,
            front,
            ..Panel::default()
        };
        Figure { title: "Chart".into(), panels: vec![panel.clone(), panel], columns: 2, panel: [420, 320] }
    }

    #[test]
    fn a_figure_is_whole_as_svg_and_as_png() {
        let svg = figure().svg().unwrap();
        assert!(svg.starts_with("<svg") && svg.trim_end().ends_with("</svg>"));
        assert_eq!(svg.matches("<title>steps 5 &lt;fast&gt;</title>").count(), 4);
        assert!(svg.contains("our default") && svg.contains("Pareto front"));
        let png = image::load_from_memory(&figure().png().unwrap()).unwrap().to_rgb8();
        assert_eq!(png.dimensions(), (2 * (2 * 420 + LEGEND), 2 * (320 + HEADING)));
        // Lettered: without a font the heading would stay white.
        let heading = (0..300).flat_map(|x| (20..50).map(move |y| (x, y)));
        assert!(heading.filter(|&(x, y)| png.get_pixel(x, y)[0] < 100).count() > 100);
    }

    #[test]
    fn the_front_holds_what_nothing_beats() {
        let points = [(1.0, 0.5), (2.0, 0.4), (2.0, 0.6), (3.0, 0.6), (4.0, 0.9), (f64::NAN, 1.0)];
        assert_eq!(front(&points), [(1.0, 0.5), (2.0, 0.6), (4.0, 0.9)]);
    }
}
