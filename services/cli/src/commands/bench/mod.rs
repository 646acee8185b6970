//! `segwild bench`: one module per benchmark, each with its arguments, a call into `segwild_eval` or `segwild_bench`,
//! and words out.

mod chart;
mod clicks;
mod command_line;
mod compare;
mod engine;
mod farm;
mod flow;
mod folder;
mod lego;
mod photo_tourism;
mod protocol_flags;
mod reconstruction;
mod scale;
mod scene_args;
mod scribbles;
mod slice;
mod stability;
mod studio;
mod synthetic;
mod tables;

use crate::failure::Failure;
use clap::{ArgMatches, Command};

/// The command's arguments. Without the name of a benchmark it is `synthetic`, whose help has its flags.
pub fn command() -> Command {
    synthetic::with_args(Command::new("bench").about("Measure: how accurate, how fast, how stable"))
        .mut_args(|arg| arg.hide(true))
        .after_help(format!(
            "Without the name of a benchmark it is `synthetic`, with its flags.\n\n{}",
            crate::args::examples(
                "segwild bench synthetic --table baselines",
                "segwild bench chart --scene photos/trevi",
            )
        ))
        .args_conflicts_with_subcommands(true)
        .subcommand(synthetic::command())
        .subcommand(folder::command())
        .subcommand(photo_tourism::command())
        .subcommand(lego::command())
        .subcommand(scribbles::nvos_command())
        .subcommand(scribbles::spin_nerf_command())
        .subcommand(chart::command())
        .subcommand(chart::point_command())
        .subcommand(compare::command())
        .subcommand(tables::command())
        .subcommand(flow::command())
        .subcommand(farm::command())
        .subcommand(engine::command())
        .subcommand(scale::command())
        .subcommand(reconstruction::command())
        .subcommand(clicks::command())
        .subcommand(slice::command())
        .subcommand(stability::command())
        .subcommand(studio::command())
}

/// Measures what is requested.
pub fn bench(matches: &ArgMatches) -> Result<(), Failure> {
    match matches.subcommand() {
        Some(("farm", m)) => farm::farm(m),
        Some(("chart", m)) => chart::chart(m),
        Some(("clicks", m)) => clicks::clicks(m),
        Some(("compare", m)) => compare::compare(m),
        Some(("reconstruction", m)) => reconstruction::reconstruction(m),
        Some(("scale", m)) => scale::scale(m),
        Some(("slice", m)) => slice::slice(m),
        Some(("stability", m)) => stability::stability(m),
        Some(("studio", m)) => studio::studio(m),
        Some(("point", _)) => chart::point(),
        Some(("synthetic", m)) => synthetic::synthetic(m),
        Some(("folder", m)) => folder::folder(m),
        Some(("photo-tourism", m)) => photo_tourism::photo_tourism(m),
        Some(("lego", m)) => lego::lego(m),
        Some(("nvos", m)) => scribbles::nvos(m),
        Some(("spin-nerf", m)) => scribbles::spin_nerf(m),
        Some(("tables", m)) => tables::tables(m),
        Some(("flow", m)) => flow::flow(m),
        Some(("engine", m)) => engine::engine(m),
        _ => synthetic::synthetic(matches),
    }
}
