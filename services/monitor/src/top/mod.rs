//! `segwild top`: the view in a terminal, over SSH as well; `frame` is the same as text.

mod page;

use std::io;
use std::time::{Duration, Instant};

use ratatui::buffer::Buffer;
use ratatui::crossterm::event::{self, Event, KeyCode, KeyEventKind, KeyModifiers};
use ratatui::layout::Rect;
use ratatui::text::Line;
use ratatui::widgets::{Paragraph, Widget};

pub use page::ScreenPosition;

use crate::view::{MonitorTarget, MonitorView, Runs};

/// Time between two refreshes.
const EVERY: Duration = Duration::from_secs(1);

/// Draws a view.
pub fn draw(view: &MonitorView, position: ScreenPosition, area: Rect, buffer: &mut Buffer) {
    Paragraph::new(page::lines(view, position, area.width, area.height)).render(area, buffer);
}

/// A view as text, lines without trailing blanks.
pub fn frame(view: &MonitorView, width: u16, height: u16) -> String {
    let area = Rect::new(0, 0, width, height);
    let mut buffer = Buffer::empty(area);
    draw(view, ScreenPosition::default(), area, &mut buffer);
    let row = |y| (0..width).map(|x| buffer[(x, y)].symbol()).collect::<String>().trim_end().to_owned();
    let mut rows: Vec<String> = (0..height).map(row).collect();
    while rows.last().is_some_and(String::is_empty) {
        rows.pop();
    }
    rows.join("\n")
}

/// Shows a target until `q`, Escape or Ctrl-C. Up and down choose a scene.
///
/// # Errors
/// When the terminal cannot be used.
pub fn follow(target: &MonitorTarget) -> io::Result<()> {
    let mut terminal = ratatui::try_init()?;
    let outcome = watch(&mut terminal, target);
    // The terminal is given back whatever happened; an error of its own is less telling than the first one.
    let restored = ratatui::try_restore();
    outcome.and(restored)
}

fn watch(terminal: &mut ratatui::DefaultTerminal, target: &MonitorTarget) -> io::Result<()> {
    let (mut position, mut runs) = (ScreenPosition::default(), Runs::default());
    loop {
        let looked = Instant::now();
        let view = target.read(&mut runs);
        loop {
            terminal.draw(|f| match &view {
                Ok(view) => draw(view, position, f.area(), f.buffer_mut()),
                Err(error) => Paragraph::new(Line::from(error.to_string())).render(f.area(), f.buffer_mut()),
            })?;
            let left = EVERY.saturating_sub(looked.elapsed());
            if left.is_zero() || !event::poll(left)? {
                break;
            }
            let Event::Key(key) = event::read()? else { continue };
            if key.kind == KeyEventKind::Release {
                continue;
            }
            let scenes = match &view {
                Ok(MonitorView::Batch(batch)) => batch.scenes.len(),
                _ => 0,
            };
            match key.code {
                KeyCode::Char('q') | KeyCode::Esc => return Ok(()),
                KeyCode::Char('c') if key.modifiers.contains(KeyModifiers::CONTROL) => return Ok(()),
                KeyCode::Down | KeyCode::Char('j') if scenes > 0 => {
                    position.scene = Some(position.scene.map_or(0, |i| (i + 1).min(scenes - 1)));
                }
                KeyCode::Up | KeyCode::Char('k') if scenes > 0 => {
                    position.scene = position.scene.and_then(|i| i.checked_sub(1));
                }
                _ => {}
            }
        }
    }
}
