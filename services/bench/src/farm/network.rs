//! A network of its own for workers, whose link can be cut: Linux, root, and `ip` of iproute2.

use super::error::FarmBenchError;
use std::path::Path;
use std::process::Command;

/// A network namespace with a link to this machine's network; both are removed when this value is dropped. A process has one at
/// a time.
#[derive(Debug)]
pub struct CutNetwork {
    name: String,
    /// The ends of the link.
    outside: String,
    inside: String,
    /// The address of the outer end.
    address: String,
}

fn ip(args: &[&str]) -> bool {
    Command::new("ip").args(args).output().is_ok_and(|output| output.status.success())
}

impl CutNetwork {
    /// Makes one; `None` where this process may not, or there is no `ip`.
    pub fn new() -> Option<CutNetwork> {
        let id = std::process::id();
        let net = format!("10.{}.{}", 200 + (id >> 8) % 50, id % 256);
        let network = CutNetwork {
            name: format!("segwild-{id}"),
            outside: format!("sw{id}o"),
            inside: format!("sw{id}i"),
            address: format!("{net}.1"),
        };
        let CutNetwork { name, outside, inside, address } = &network;
        let (outer, inner) = (format!("{address}/30"), format!("{net}.2/30"));
        let made = ip(&["netns", "add", name])
            && ip(&["link", "add", outside, "type", "veth", "peer", "name", inside])
            && ip(&["link", "set", inside, "netns", name])
            && ip(&["addr", "add", &outer, "dev", outside])
            && ip(&["link", "set", outside, "up"])
            && ip(&["-n", name, "addr", "add", &inner, "dev", inside])
            && ip(&["-n", name, "link", "set", inside, "up"]);
        made.then_some(network)
    }

    /// This machine's address on the link: a server that listens there is reached from both networks.
    pub fn address(&self) -> &str {
        &self.address
    }

    /// A command that runs a program in it. The process that it starts is the program's.
    pub fn command(&self, program: &Path) -> Command {
        let mut command = Command::new("ip");
        command.args(["netns", "exec", &self.name]).arg(program);
        command
    }

    /// Cuts its link, or restores it. Nobody on either side closes a connection.
    ///
    /// # Errors
    /// [`FarmBenchError::Link`] when the system refuses.
    pub fn link(&self, up: bool) -> Result<(), FarmBenchError> {
        let state = if up { "up" } else { "down" };
        match ip(&["-n", &self.name, "link", "set", &self.inside, state]) {
            true => Ok(()),
            false => Err(FarmBenchError::Link { link: self.inside.clone(), state }),
        }
    }
}

impl Drop for CutNetwork {
    fn drop(&mut self) {
        // The inner end goes with the outer one.
        let _ = ip(&["link", "del", &self.outside]);
        let _ = ip(&["netns", "del", &self.name]);
    }
}
