//! `report.html`: one self-contained page with all that a run did.

mod add;
mod html;
mod objects;
mod page;
mod shown;

pub(crate) use add::add_object;
pub use page::write_report;
