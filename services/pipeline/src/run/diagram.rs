//! The graph of a run as text: Mermaid, or DOT of Graphviz.

use super::need::Extent;
use super::node::{Performer, StageNode};
use super::stages::NODES;
use std::fmt::Write as _;

segwild_scene::choice! {
    /// How the graph of a run is written.
    pub enum DiagramFormat {
        /// Mermaid, as Markdown pages show it.
        Mermaid = "mermaid",
        /// DOT, for Graphviz.
        Dot = "dot",
    }
}

/// A source: it only sends.
struct SourceBox {
    id: String,
    title: &'static str,
}

/// Stages of one actor.
struct ActorBox {
    id: String,
    title: String,
    stages: Vec<&'static str>,
}

/// What flows from one box to another.
struct Arrow {
    from: String,
    to: String,
    what: &'static str,
    /// Waited for photo by photo, after the start.
    per_photo: bool,
}

/// A name as an identifier.
fn id(name: &str) -> String {
    name.replace(' ', "_")
}

fn boxes() -> (Vec<ActorBox>, Vec<SourceBox>) {
    let (mut actors, mut sources): (Vec<ActorBox>, Vec<SourceBox>) = (Vec::new(), Vec::new());
    for node in NODES {
        let name = node.stage.name();
        sources.extend(node.feed.map(|feed| SourceBox { id: id(feed.source), title: feed.source }));
        let title = match node.by {
            Performer::Actor(actor) => format!("{actor} actor"),
            Performer::Programs => "COLMAP, where photos come without poses".to_owned(),
            Performer::Run => "the run itself, after the actors".to_owned(),
            Performer::Source => {
                sources.push(SourceBox { id: id(name), title: name });
                continue;
            }
        };
        match actors.iter_mut().find(|actor| actor.title == title) {
            Some(actor) => actor.stages.push(name),
            None => {
                let id = match node.by {
                    Performer::Actor(actor) => format!("{actor}_actor"),
                    Performer::Programs => "programs".to_owned(),
                    _ => "run".to_owned(),
                };
                actors.push(ActorBox { id, title, stages: vec![name] });
            }
        }
    }
    (actors, sources)
}

/// The arrows into a stage; where a source sends to its actor, what the stage needs goes to the source.
fn arrows(node: &StageNode) -> Vec<Arrow> {
    let stage = node.stage.name();
    let source = node.feed.map(|feed| id(feed.source));
    let mut arrows: Vec<Arrow> = (node.needs.iter())
        .map(|need| Arrow {
            from: need.stage.name().to_owned(),
            to: source.clone().unwrap_or_else(|| stage.to_owned()),
            what: need.what,
            per_photo: need.extent == Extent::PerPhoto,
        })
        .collect();
    arrows.extend(node.feed.map(|feed| Arrow {
        from: id(feed.source),
        to: stage.to_owned(),
        what: feed.sends,
        per_photo: false,
    }));
    arrows
}

/// The graph of a run: boxes are stages, in the actor that computes them; rounded ones are sources. A solid arrow is
/// waited for before the start, a dotted one photo by photo after it; `*` is one message per photo.
///
/// ```
/// use segwild_pipeline::{DiagramFormat, diagram};
/// assert!(diagram(DiagramFormat::Mermaid).starts_with("flowchart LR\n"));
/// assert!(diagram(DiagramFormat::Dot).starts_with("digraph run {\n"));
/// ```
pub fn diagram(format: DiagramFormat) -> String {
    match format {
        DiagramFormat::Mermaid => mermaid(),
        DiagramFormat::Dot => dot(),
    }
}

fn mermaid() -> String {
    let (actors, sources) = boxes();
    let mut text = "flowchart LR\n".to_owned();
    for SourceBox { id, title } in sources {
        let _ = writeln!(text, "  {id}([{title}])");
    }
    for ActorBox { id, title, stages } in actors {
        let _ = writeln!(text, "  subgraph {id}[\"{title}\"]");
        stages.iter().for_each(|stage| text += &format!("    {stage}\n"));
        text += "  end\n";
    }
    for Arrow { from, to, what, per_photo } in NODES.iter().flat_map(arrows) {
        let arrow = match (what, per_photo) {
            ("", false) => "-->".to_owned(),
            ("", true) => "-.->".to_owned(),
            (what, false) => format!("-- \"{what}\" -->"),
            (what, true) => format!("-. \"{what}\" .->"),
        };
        let _ = writeln!(text, "  {from} {arrow} {to}");
    }
    text
}

fn dot() -> String {
    let (actors, sources) = boxes();
    let mut text = "digraph run {\n  rankdir=LR;\n  node [shape=box];\n".to_owned();
    for SourceBox { id, title } in sources {
        let _ = writeln!(text, "  {id} [label=\"{title}\", style=rounded];");
    }
    for ActorBox { id, title, stages } in actors {
        let stages = stages.join("; ");
        let _ = writeln!(text, "  subgraph cluster_{id} {{ label=\"{title}\"; {stages}; }}");
    }
    for Arrow { from, to, what, per_photo } in NODES.iter().flat_map(arrows) {
        let style = if per_photo { ", style=dotted" } else { "" };
        let _ = writeln!(text, "  {from} -> {to} [label=\"{what}\"{style}];");
    }
    text + "}\n"
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The first Mermaid block of a page.
    fn block(page: &str) -> &str {
        let (_, rest) = page.split_once("```mermaid\n").expect("a Mermaid block");
        rest.split_once("```").expect("its end").0
    }

    #[test]
    fn the_architecture_page_has_the_graph_that_the_program_prints() {
        let path = concat!(env!("CARGO_MANIFEST_DIR"), "/../../ARCHITECTURE.md");
        let page = std::fs::read_to_string(path).expect("the page");
        let now = diagram(DiagramFormat::Mermaid);
        assert_eq!(block(&page), now, "`segwild run SCENE --explain --graph` prints it");
    }

    #[test]
    fn both_formats_have_every_stage_and_every_need() {
        for (format, arrow) in [(DiagramFormat::Mermaid, "-"), (DiagramFormat::Dot, "->")] {
            let text = diagram(format);
            for node in NODES {
                assert!(text.contains(node.stage.name()), "{}", node.stage);
                for need in node.needs {
                    let from = format!("  {} {arrow}", need.stage);
                    assert!(text.lines().any(|l| l.starts_with(&from) && l.contains(need.what)), "{from}");
                }
            }
        }
    }
}
