pub mod constant;
#[cfg(target_os = "linux")]
pub(crate) mod interface_watch;
pub mod udp_listener;
pub mod udp_sender;
pub mod util;
