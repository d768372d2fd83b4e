//! Configurations that load, and what they become.

use super::*;
use crate::config::needle::Arc;
use crate::config::warnings::section_name;
use crate::control::ControlKind;
use crate::emulator::{self, CorrelatedNoise};
use crate::keys::{Kind, find};
use crate::stage::{RawSdo, StageConfig};

#[test]
fn every_shipped_configuration_loads_and_reads_back_the_same() {
    let files = shipped();
    assert!(files.len() >= 5, "{}", files.len());
    for (name, text) in files {
        let config = Config::from_sources(&[Source { name: &name, text: &text }], &[])
            .unwrap_or_else(|error| panic!("{error}"));
        let again = config.to_toml().expect("TOML");
        assert_eq!(loaded(&again, &[]), config, "{name}");
        config.to_stage().unwrap_or_else(|error| panic!("{name}: {error}"));
    }
}

#[test]
fn the_defaults_are_those_of_virtual_toml() {
    assert_eq!(loaded("", &[]), loaded(DEFAULT_TOML, &[]));
}

#[test]
fn one_key_changes_that_key_alone() {
    let mut expected = loaded("", &[]);
    expected.insertion.depth_mm = 80.0;
    expected.toml["insertion"]["depth_mm"] = 80.0.into();
    assert_eq!(loaded("insertion.depth_mm = 80", &[]), expected);
    assert_eq!(loaded("[insertion]\ndepth_mm = 80.0", &[]), expected);
    assert_eq!(loaded("insertion = { depth_mm = 80 }", &[]), expected);
    assert_eq!(loaded("", &["insertion.depth_mm=80"]), expected);
}

#[test]
fn the_command_line_is_laid_over_the_file_and_the_last_one_counts() {
    let config = loaded("insertion.depth_mm = 80", &["insertion.depth_mm=90"]);
    assert_eq!(config.insertion.depth_mm, 90.0);
    let config = loaded("", &["insertion.depth_mm=90", "insertion.depth_mm = 95.5"]);
    assert_eq!(config.insertion.depth_mm, 95.5);
}

#[test]
fn strings_need_no_quotes_on_the_command_line() {
    let config = loaded(
        "tracker.source = \"openigtlink\"",
        &["can.interface=vcan1", "tracker.address=lab-7:18944", "name=\"a\""],
    );
    assert_eq!(config.can.interface, CanInterface::Socket("vcan1".to_owned()));
    assert_eq!(config.tracker.address, "lab-7:18944");
    assert_eq!(config.name, "a");
}

#[test]
fn a_bus_is_read_and_printed_by_its_name() {
    let bus = |name: &str| {
        let interface = format!("can.interface={name}");
        let config = loaded("tracker.source = \"openigtlink\"", &[&interface]);
        config.can.interface
    };
    assert_eq!(bus("vcan0"), CanInterface::Socket("vcan0".to_owned()));
    let group = |text: &str| CanInterface::Udp(text.parse().unwrap());
    assert_eq!(bus("udp"), group("239.74.163.2:43113"));
    assert_eq!(bus("udp:239.1.2.3:4000"), group("239.1.2.3:4000"));
    for name in ["udp", "udp:239.1.2.3:4000", "vcan0"] {
        assert_eq!(bus(name).to_string(), name);
        assert_eq!(bus(name).is_for_tests(), name != "vcan0");
    }
    for (name, is_virtual) in
        [("memory", true), ("udp", true), ("vcan0", true), ("vxcan1", true), ("can0", false)]
    {
        assert_eq!(
            CanInterface::named(name).map(|bus| bus.is_virtual()),
            Some(is_virtual),
            "{name}"
        );
    }
}

#[test]
fn an_alternative_replaces_the_other_one_of_an_earlier_source() {
    let config = loaded("needle.curvature_per_mm = 0.01", &[]);
    assert_eq!(config.needle.arc, Arc { radius_mm: None, curvature_per_mm: Some(0.01) });
    let config = loaded("needle.curvature_per_mm = 0.01", &["needle.radius_mm=50"]);
    assert_eq!(config.needle.arc, Arc { radius_mm: Some(50.0), curvature_per_mm: None });
    assert_eq!(config.needle.arc.curvature_per_mm(), 0.02);

    let noise = |text: &str, sets: &[&str]| {
        let noise = loaded(text, sets).emulator.noise;
        (noise.uniform_mm, noise.sd_mm)
    };
    assert_eq!(noise("emulator.noise = {}", &[]), (None, None));
    assert_eq!(noise("emulator.noise.sd_mm = 0.1", &[]), (None, Some(0.1)));
    assert_eq!(noise("", &["emulator.noise.sd_mm=0.1"]), (None, Some(0.1)));
    assert_eq!(noise("emulator.noise = {}", &["emulator.noise={uniform_mm=2}"]), (Some(2.0), None));
}

#[test]
fn correlated_noise_is_read_besides_white_noise() {
    let tracker = |set: &str| loaded("", &[set]).emulator.to_tracker();
    assert_eq!(tracker("emulator.noise.sd_mm=0.1").correlated, None);
    let noise =
        "emulator.noise={ uniform_mm = 0.7, correlated_sd_mm = 0.4, correlation_time_s = 0.2 }";
    let tracker = tracker(noise);
    assert_eq!(tracker.noise, emulator::WhiteNoise::Uniform(0.7));
    assert_eq!(tracker.correlated, Some(CorrelatedNoise { sd_mm: 0.4, time_s: 0.2 }));
}

/// The jump test takes the larger of two standard deviations: the correlated part is a share of that one.
#[test]
fn correlated_noise_is_a_share_of_what_the_track_assumes() {
    let share = |gate_sd_mm: &str| {
        let noise =
            "tracker.noise={ white_sd_mm = 0.3, correlated_sd_mm = 0.4, correlation_time_s = 0.2 }";
        let gate = format!("tracker.gates.noise_sd_mm={gate_sd_mm}");
        loaded("", &[noise, &gate]).tracker.to_track().correlated.map(|(share, _)| share)
    };
    assert!(share("0.1").is_some_and(|share| (share - 0.64).abs() < 1e-12));
    assert!(share("0.8").is_some_and(|share| (share - 0.25).abs() < 1e-12));
    assert_eq!(loaded("", &[]).tracker.to_track().correlated, None);
}

/// The warning about a section without effect finds the section by this name.
#[test]
fn each_observer_and_each_law_has_its_section() {
    for (table, kinds) in [("observer", ObserverKind::KIND), ("control", ControlKind::KIND)] {
        let Kind::OneOf(kinds) = kinds else { panic!("{table}") };
        for (kind, _) in kinds {
            let section = format!("{table}.{}", section_name(kind));
            assert!(find(Config::KEYS, &section).is_some(), "{section}");
        }
    }
}

/// A limit in the section of another control law would limit nothing.
#[test]
fn shipped_files_give_no_warning_and_keys_without_effect_do() {
    let warnings = |name: &str, text: &str| {
        let no_files = |_: &Path| Err(String::new());
        Config::with_warnings(&[Source { name, text }], &[], &no_files).expect("valid").1
    };
    for (name, text) in shipped() {
        assert_eq!(warnings(&name, &text), [""; 0]);
    }
    let config = loaded(RIG, &[]);
    let rotation = config.control.rotation_max_rad_per_mm() * config.insertion.speed_mm_per_s;
    assert_eq!(rotation, 20f64.to_radians(), "20 deg/s, as the file says");
    assert_eq!(
        warnings("a.toml", "[observer]\nshadows = []\nfinite_difference.baseline_mm = 3\n"),
        ["a.toml:3: observer.finite_difference.baseline_mm has no effect, since observer.kind is \
             \"invariant\": choose observer.kind = \"finite-difference\", or add \"finite-difference\" to \
             observer.shadows"]
    );
    for text in [
        "observer.shadows = [\"finite-difference\"]\nobserver.finite_difference.baseline_mm = 3",
        "observer.finite_difference = {}",
        &loaded("", &[]).to_toml().expect("TOML"),
    ] {
        assert_eq!(warnings("a.toml", text), [""; 0]);
    }
    for (text, expected) in [
        ("observer = { kind = \"coupled\", coupled.gains = \"placed\" }", "15% of 300 insertions"),
        ("observer.kind = \"finite-difference\"", "its roll is noise"),
        ("needle.torsion = { half_width_deg = 40, creep_mm = 2 }", "has a band and a creep"),
        (
            "observer.kind = \"coupled\"\nneedle.torsion.half_width_deg = 40",
            "takes the shaft to be rigid",
        ),
    ] {
        let warnings = warnings("a.toml", text);
        assert!(matches!(&warnings[..], [warning] if warning.contains(expected)), "{warnings:?}");
        assert!(warnings[0].len() < 200, "{}", warnings[0]);
    }
    assert_eq!(warnings("a.toml", "observer.kind = \"coupled\""), [""; 0]);

    // A real needle is not exactly like its model.
    let noise = "[observer.invariant.noise]";
    let (before, after) = RIG.split_once(noise).expect("the section");
    let (_, after) = after.split_once("\n\n").expect("its end");
    let exact = warnings("rig.toml", &format!("{before}{after}"));
    assert!(
        matches!(&exact[..], [warning] if warning.starts_with("observer.invariant.noise is 0"))
    );
    assert!(exact[0].len() < 200, "{}", exact[0]);
    let some = format!("{before}{noise}\nheading_deg = 0.1\n\n{after}");
    assert_eq!(warnings("rig.toml", &some), [""; 0]);
}

#[test]
fn a_real_tracker_has_no_registration_unless_one_is_given() {
    let config = loaded("", &[]);
    assert!(config.session().is_ok());
    let config = loaded("can.interface = \"vcan0\"\ntracker.source = \"openigtlink\"", &[]);
    assert_eq!(
        config.tracker.to_registration().expect_err("none").to_string(),
        "tracker.registration is missing, and has no default for tracker.source = \"openigtlink\": \
         measure it by needle-bench calibrate registration, and name its file in \
         tracker.registration_file"
    );
    assert_eq!(
        refusal(
            "can.interface = \"vcan0\"\n[tracker]\nsource = \"openigtlink\"\n\
             registration = { x_mm = 1 }"
        )
        .lines()
        .next(),
        Some(
            "bench.toml:4: tracker.registration.y_mm is missing and has no default here, \
             expected a number in mm"
        )
    );
}

#[test]
fn the_columns_of_a_recording_are_read_with_their_units() {
    let config = loaded(
        "[tracker]\nsource = \"csv\"\nfile = \"tip.csv\"\n\
         [tracker.csv]\ntime = { s = \"sec\", ns = \"nanosec\" }\nposition_unit_mm = 1000\n\
         stamp = { ms = \"t\" }\nquaternion_wxyz = [\"a\", \"b\", \"c\", \"d\"]\nskip_s = 1.5\n",
        &["tracker.tool=Tip", "tracker.csv.position=[\"x\", \"y\", \"z\"]"],
    );
    let mapping = config.tracker.csv;
    let columns = mapping.time.named().collect::<Vec<_>>();
    assert_eq!(columns, [("sec", 1_000_000_000), ("nanosec", 1)]);
    assert_eq!(mapping.stamp.expect("given").named().collect::<Vec<_>>(), [("t", 1_000_000)]);
    assert_eq!((mapping.position_unit_mm, mapping.skip.as_millis()), (1000.0, 1500));
    assert_eq!(mapping.position, ["x", "y", "z"]);
    assert_eq!(mapping.quaternion_wxyz.expect("given"), ["a", "b", "c", "d"]);
    let default = loaded("", &[]).tracker.csv;
    assert_eq!(default.time.named().collect::<Vec<_>>(), [("time_s", 1_000_000_000)]);
    assert_eq!(default.position[0], "x_meas_mm");
}

#[test]
fn the_rig_file_lacks_only_a_registration() {
    let config = loaded(RIG, &[]);
    assert!(config.stage.hardware);
    assert_eq!(config.stage.insertion.product_code, None);
    let error = config.session().expect_err("no registration").to_string();
    assert!(error.starts_with("tracker.registration is missing"), "{error}");
    let pose = "{x_mm=1, y_mm=2, z_mm=3, yaw_deg=0, pitch_deg=90, roll_deg=0}";
    let config = loaded(RIG, &[&format!("tracker.registration={pose}")]);
    assert!(config.session().is_ok());
    let registration = config.tracker.to_registration().expect("given");
    let on_axis = registration.x_wt().transform(&nalgebra::Vector3::z());
    assert!((on_axis - nalgebra::Vector3::new(2.0, 2.0, 3.0)).norm() < 1e-12);
}

#[test]
fn the_stage_gets_counts_mm_and_radians() {
    let config = loaded(
        "[stage.insertion]\nfollowing_error_mm = 0.7\n\
         [stage.rotation]\nfollowing_error_deg = 3.6\ncounts_per_turn = { counts = 1000, turns = 1 }\n\
         optional_objects = [0x60C2]\nsign = -1\n\
         [[stage.rotation.sdo]]\nindex = 0x2310\nsubindex = 1\nvalue = -2\nbits = 16\n\
         [[stage.rotation.sdo]]\nindex = 0x2311\nsubindex = 1\nvalue = 0x65766173\nbits = 32\n\
         read_back = false\n",
        &[],
    );
    let stage = config.to_stage().expect("a stage");
    let rotation = &stage.rotation;
    assert_eq!(rotation.limits.max, 7200f64.to_radians());
    assert_eq!(rotation.sign, crate::stage::Sign::Negative);
    assert_eq!(rotation.ratio.to_f64(), 1000.0);
    assert!(rotation.optional_objects.contains(&0x60C2));
    let (first, second) = (
        RawSdo { bits: 16, index: 0x2310, subindex: 1, value: -2, read_back: true },
        RawSdo { bits: 32, index: 0x2311, subindex: 1, value: 0x6576_6173, read_back: false },
    );
    assert_eq!(rotation.sdo, [first, second]);
    let windows = |stage: &StageConfig| {
        [&stage.insertion, &stage.rotation].map(|axis| axis.following_error_max)
    };
    assert_eq!(windows(&stage), [Some(0.7), Some(3.6f64.to_radians())]);
    let default = loaded("", &[]);
    let default = default.to_stage().expect("a stage");
    assert_eq!(windows(&default), [None, None]);
    assert_eq!(stage.bus.heartbeat_timeout_ms, 100);
}

#[test]
fn shadows_do_not_repeat_the_observer_that_steers() {
    let config = loaded("", &["observer.kind=finite-difference"]);
    assert_eq!(config.observer.kinds()[1..], [ObserverKind::Coupled]);
    let config = loaded("observer.shadows = [\"finite-difference\", \"finite-difference\"]", &[]);
    assert_eq!(config.observer.kinds()[1..], [ObserverKind::FiniteDifference]);
}

#[test]
fn every_shipped_file_names_the_schema() {
    for (name, text) in shipped() {
        assert!(text.starts_with("#:schema schema.json\n"), "{name}");
    }
}

/// With `NEEDLE_RECORD_ANEW=1` the test writes both files from the declarations.
#[test]
fn the_shipped_reference_and_schema_are_current() {
    let schema = format!("{:#}\n", Config::json_schema());
    let dir = Path::new(env!("CARGO_MANIFEST_DIR")).join("bench-config");
    for (name, text) in [("virtual.toml", Config::reference()), ("schema.json", schema)] {
        let path = dir.join(name);
        if std::env::var_os("NEEDLE_RECORD_ANEW").is_some() {
            std::fs::write(&path, &text).expect("written");
        }
        let shipped = std::fs::read_to_string(&path).unwrap_or_default();
        assert!(shipped == text, "bench-config/{name} is not current: NEEDLE_RECORD_ANEW=1");
    }
}

#[test]
fn the_reference_lists_the_words_of_nested_keys() {
    let reference = Config::reference();
    let nested = [
        ("emulator.fault.kind", "drop"),
        ("emulator.fault.axis", "rotation"),
        ("emulator.fault.frames", "sync"),
        ("emulator.fault.toward", "drives"),
        ("goal.obstacle.shape", "mask"),
    ];
    for (key, word) in nested {
        assert!(reference.contains(&format!("\n#     \"{word}\": ")), "{word} of {key}");
    }
}

#[test]
fn a_calibration_file_that_cannot_be_used_hides_no_other_error() {
    let text = "insertion.depth_mm = -1\n[stage]\nhardware = true\n[needle]\nneedle_file = \"needle.toml\"\n\
                [tracker]\nsource = \"openigtlink\"\nregistration_file = \"room.toml\"\n\
                tip_file = \"tip.toml\"\nhold_after_mm = -3\n";
    let read = |path: &Path| match path.ends_with("tip.toml") {
        true => Ok("needle.radius_mm = 3\n".to_owned()),
        false => Err("cannot be read".to_owned()),
    };
    let sources = [Source { name: "bench.toml", text }];
    let error = Config::with_warnings(&sources, &[], &read).unwrap_err();
    let messages: Vec<&str> = error.problems.iter().map(|p| p.message.as_str()).collect();
    for problem in [
        "bench.toml:1: insertion.depth_mm is -1",
        "bench.toml:5: needle.needle_file: cannot be read; needle-bench calibrate needle --out",
        "bench.toml:8: tracker.registration_file: cannot be read; needle-bench calibrate",
        "tip.toml:1: needle.radius_mm does not belong in a file for tracker.tip_file",
        "bench.toml:10: tracker.hold_after_mm is -3",
    ] {
        assert!(messages.iter().any(|m| m.starts_with(problem)), "{problem}: {messages:#?}");
    }
    let of_files = ["tracker.registration", "needle.radius_mm", "needle.curvature_per_mm"];
    let is_missing =
        |message: &&str| of_files.iter().any(|key| message.contains(&format!("{key} is missing")));
    assert!(!messages.iter().any(is_missing), "{messages:#?}");
}

/// The file would silently replace it.
#[test]
fn a_value_that_the_calibration_file_holds_too_is_refused() {
    let read = |_: &Path| Err("cannot be read".to_owned());
    let error_of = |text: &str, sets: &[&str]| {
        let sets: Vec<String> = sets.iter().map(|set| (*set).to_owned()).collect();
        let error = Config::with_warnings(&[Source { name: "bench.toml", text }], &sets, &read);
        error.expect_err("refused").to_string()
    };
    let needle = "needle_file = \"needle.toml\"";
    for (text, key) in [
        (format!("[needle]\n{needle}\ntip_ahead_mm = 3"), "needle.tip_ahead_mm"),
        (format!("[needle]\n{needle}\ntorsion.creep_mm = 3"), "needle.torsion"),
        (format!("needle.{needle}\nevaluation.axis = [0, 1, 0]"), "evaluation.axis"),
    ] {
        let error = error_of(&text, &[]);
        let expected = format!("needle.needle_file is given along with {key}: give one of the two");
        assert!(error.starts_with("bench.toml:") && error.contains(&expected), "{error}");
    }
    let sets = ["tracker.registration_file=r.toml", "tracker.registration.sd_mm=0.3"];
    assert_eq!(
        error_of("", &sets),
        "--set tracker.registration_file is given along with tracker.registration.sd_mm: give one of \
         the two"
    );
    // A later source may change a value of the file that an earlier source names.
    let later = error_of(&format!("needle.{needle}"), &["needle.tip_ahead_mm=3"]);
    assert!(later.starts_with("bench.toml:1: needle.needle_file: cannot be read"), "{later}");
    let later = error_of("", &["needle.needle_file=needle.toml", "needle.tip_ahead_mm=3"]);
    assert!(later.starts_with("--set needle.needle_file: cannot be read"), "{later}");
}

#[test]
fn a_value_set_over_a_calibration_drops_its_fit() {
    let origin =
        "file = \"p.csv\"\nsha256 = \"0\"\nversion = \"0\"\ndate_utc = \"2026-08-01T12:00:00Z\"";
    let text = format!(
        "[tracker.registration]\nx_mm = 1.0\ny_mm = 0.0\nz_mm = 0.0\nyaw_deg = 0.0\n\
         pitch_deg = 0.0\nroll_deg = 0.0\n\
         [tracker.registration.fit]\n{origin}\npoints = 9\nrms_mm = 0.4\nspread_mm = [9, 9, 9]\n\
         [tracker.tip_fit]\n{origin}\npoints = 9\nradius_mm = 1.0\nrms_mm = 0.4\n"
    );
    let has_fit = |set: &str| {
        let config = loaded(&text, &[set]);
        let Some(RegistrationConfig::Given(given)) = config.tracker.registration else {
            panic!("a pose is given")
        };
        [given.fit.is_some(), config.tracker.tip_fit.is_some()]
    };
    assert_eq!(has_fit("insertion.depth_mm=80"), [true, true]);
    assert_eq!(has_fit("tracker.registration.sd_mm=0.5"), [true, true]);
    assert_eq!(has_fit("tracker.registration.x_mm=2.0"), [false, true]);
    assert_eq!(has_fit("tracker.tip_tilt.roll_deg=3.0"), [true, false]);
    assert_eq!(has_fit("tracker.tip_offset_mm=[0.0, 0.0, 7.0]"), [true, false]);
}
