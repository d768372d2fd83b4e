use super::*;

#[test]
fn the_defaults_load() {
    let config = Config::from_sources(&[], &[]).map_err(|e| e.to_string()).unwrap();
    assert_eq!(config.insertion.depth_mm, 150.0);
    println!("{}", config.to_toml().unwrap());
}
